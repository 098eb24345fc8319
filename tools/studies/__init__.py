"""Studies with a known answer: what the lab says, and what the line learns, beside the truth."""
