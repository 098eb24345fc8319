"""Files in and out: YAML whose mistakes have a place, tables and pages as data."""
