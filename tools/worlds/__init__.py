"""Worlds and studies with a known answer, for all that tries the cell on them."""
