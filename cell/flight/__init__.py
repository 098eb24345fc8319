"""Correction of an insertion while it is made."""
