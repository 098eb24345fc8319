"""Worlds and studies with a known answer, for trials of the cell."""
