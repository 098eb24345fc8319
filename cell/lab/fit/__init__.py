"""Models fitted to a study or to many cables, what they foretell, and by how much it may err."""
