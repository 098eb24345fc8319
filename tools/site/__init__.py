"""The manual as a site: pages of docs, and references generated from the code."""
