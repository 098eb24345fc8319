"""This computer: a second process, memory."""
