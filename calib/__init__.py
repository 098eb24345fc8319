"""How pixels, robot and clocks map to the cell's plane."""
