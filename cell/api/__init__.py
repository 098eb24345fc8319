"""What the lab's commands do, as functions whose results a notebook shows."""
