"""The ledger: a database of all cycles of one line, or of a plant's."""
