"""Simulated and emulated cells: hidden cables, twins and emulators, wired to settings."""
