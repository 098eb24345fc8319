"""The model lab: which physical effect is missing?

A diagnosis is four questions, each with a room: what could it be (`search`), what does the best
model leave (`statistics`), may we say so (`verdict`), how much, and what next (`strength`, `next`).
"""
