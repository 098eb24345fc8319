"""Records of cycles on disk."""
