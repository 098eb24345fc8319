"""Offsets, destination and smooth paths: which motion, and how likely it passes."""
