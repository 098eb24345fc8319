"""The model lab: which physical effect is missing?

`diagnosis` is the page to begin with: its stages, in order, are the rooms of the lab.
"""
