"""Measurements, trials and figures of the cell: run as modules from the project's root."""
