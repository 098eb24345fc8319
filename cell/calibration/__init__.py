"""Calibrates a cell: shows, moves and films what is needed, and keeps what it finds."""
