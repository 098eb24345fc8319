"""What measures, tries and draws the cell: run as modules from the project's root."""
