"""How much: parameters and effects with intervals, limits, profiles, agreement of trials."""
