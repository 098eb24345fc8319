"""Import of other programs' files as a study: read files, propose a mapping, make trials."""
