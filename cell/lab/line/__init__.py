"""Several cables: one answer of several studies, and what recorded cables of a line share."""
