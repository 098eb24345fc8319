"""Learning from recorded cables of a line: the effect that its model lacks, and a candidate."""
