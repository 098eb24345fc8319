"""Physical effects that may be added to a cable: one file per family, and a user's own."""
