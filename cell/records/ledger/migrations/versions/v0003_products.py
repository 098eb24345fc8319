"""Which product a cycle has made."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the column, empty for what was made before, and its index."""
    op.add_column("cycles", sa.Column("product", sa.String(64)))
    op.create_index("by_product", "cycles", ["line", "product", "ordered", "id"])
