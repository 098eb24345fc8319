"""The simulated world and the twins of the three devices."""
