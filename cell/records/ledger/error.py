"""What goes wrong with a ledger."""


class LedgerError(Exception):
    """The ledger cannot be used.  Scenario: the plant's database server is being updated."""
