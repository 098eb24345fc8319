"""Pages for operators and engineers: a client of the cell, in its own process."""
