"""A cell put together from its settings: with real, simulated, filmed or replayed devices."""
