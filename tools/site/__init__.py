"""The manual as a site: pages of docs, and references that are written from the code."""
