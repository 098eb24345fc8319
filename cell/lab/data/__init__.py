"""What goes in and comes out: studies made ready, noise, cycles, limits, checks, results."""
