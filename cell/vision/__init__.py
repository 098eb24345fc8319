"""Image → nodes of the cable, in metres in the cell's plane."""
