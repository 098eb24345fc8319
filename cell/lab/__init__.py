"""The model lab: which physical effect is missing?"""
