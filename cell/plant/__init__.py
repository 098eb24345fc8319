"""Connects a cell to its plant: other machines start it, a plant's systems observe it."""
