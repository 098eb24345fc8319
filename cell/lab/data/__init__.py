"""What goes into the lab and comes out: studies made ready, noise, recorded cycles, results."""
