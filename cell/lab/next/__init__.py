"""What to measure next, and what that would show: advice, motions, power, laws to discover."""
