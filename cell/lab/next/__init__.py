"""What to do next: advice, the motion that tells most, laws to be discovered."""
