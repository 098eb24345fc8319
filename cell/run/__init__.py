"""One cycle while it happens: states, steps, plans, filming, watch, faults, dry run."""
