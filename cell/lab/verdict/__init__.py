"""The verdict on a study: evidence, checks, ties, doubts, conclusion."""
