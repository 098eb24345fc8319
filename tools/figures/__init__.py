"""Figures of the documentation: pictures, drawings and plots."""
