"""One module per change, each on top of the one before."""
