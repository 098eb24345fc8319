"""What a cycle leaves behind on disk."""
