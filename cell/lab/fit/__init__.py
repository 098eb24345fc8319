"""Models fitted to a study or to many cables, their predictions, and the errors of these."""
