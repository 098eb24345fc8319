"""Sets of effects fitted to a study, each set once, screened and compared."""
