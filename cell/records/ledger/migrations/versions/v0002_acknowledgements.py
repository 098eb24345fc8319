"""Who has acknowledged the fault of a cycle."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Make the table."""
    key = sa.ForeignKey("cycles.id", ondelete="CASCADE")
    op.create_table(
        "acknowledgements",
        sa.Column("cycle_id", sa.Integer, key, primary_key=True),
        sa.Column("at", sa.DateTime, nullable=False),
        sa.Column("by", sa.String(100), nullable=False),
        sa.Column("note", sa.Text, nullable=False),
    )
