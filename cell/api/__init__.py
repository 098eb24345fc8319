"""The lab's commands as functions, whose results a notebook shows."""
