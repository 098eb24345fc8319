"""Devices behind interfaces; imports nothing of the cell."""
