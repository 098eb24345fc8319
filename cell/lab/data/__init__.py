"""Inputs and results of the lab: prepared studies, noise, cycles, limits, checks, results."""
