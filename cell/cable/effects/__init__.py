"""Physical effects that can be added to the cable model, one family per file."""
