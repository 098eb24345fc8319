"""What a study could show: an effect hidden in copies of it, as forecast and as diagnosed."""
