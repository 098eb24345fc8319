"""Changes of the ledger's tables, one after another; carried out by Alembic."""
