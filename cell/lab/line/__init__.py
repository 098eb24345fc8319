"""Several cables: the joint diagnosis of studies, and learning from the cables of a line."""
