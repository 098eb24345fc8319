"""What may be claimed of a study: evidence, checks, ties, doubts, conclusion."""
