"""A robot cell that identifies each cable it holds and inserts it."""
