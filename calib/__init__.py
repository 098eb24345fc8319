"""Calibrations: pixels ↔ metres in the cell's plane, robot poses, and clocks."""
