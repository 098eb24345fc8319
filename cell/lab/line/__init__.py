"""What recorded cables of a line have in common: what its model lacks, and a candidate for it."""
