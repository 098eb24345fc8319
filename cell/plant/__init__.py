"""The cell in a line of a plant: started by other machines, watched by a plant's systems."""
