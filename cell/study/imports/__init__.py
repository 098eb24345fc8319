"""Anybody's measurements as a study: files read, what their data show, a mapping, the trials."""
