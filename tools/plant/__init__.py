"""Plants around a cell: what lines do to it, and what that costs it."""
