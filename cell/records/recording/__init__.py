"""One MCAP file per cycle: frames, poses, states and decisions, written while they happen."""
