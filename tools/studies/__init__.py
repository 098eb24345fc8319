"""Studies with a known answer: results of lab and line compared with the truth."""
