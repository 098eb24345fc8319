"""Strength of effects and parameters: intervals, limits, profiles, agreement of trials."""
