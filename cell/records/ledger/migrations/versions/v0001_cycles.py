"""The first ledger: parts, cycles, parameters, faults, times."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

_NUMBERS = (
    *("offset_m", "predicted_miss_m", "measured_miss_m", "margin_m", "predicted_margin_m"),
    *("predicted_std_m", "probability", "prediction_error_m", "residual_rms_m", "noise_m"),
    *("wait_s", "speed"),
)


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "parts",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("code", sa.String(200), nullable=False, unique=True),
    )
    op.create_table(
        "cycles",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("uid", sa.String(300), nullable=False, unique=True),
        sa.Column("line", sa.String(100), nullable=False),
        sa.Column("cycle", sa.Integer, nullable=False),
        sa.Column("part_id", sa.Integer, sa.ForeignKey("parts.id")),
        sa.Column("folder", sa.Text, nullable=False),
        sa.Column("aim", sa.String(20), nullable=False),
        sa.Column("started", sa.DateTime, nullable=False),
        sa.Column("ordered", sa.DateTime, nullable=False),
        sa.Column("ended", sa.DateTime),
        sa.Column("outcome", sa.String(20)),
        sa.Column("reason", sa.Text),
        sa.Column("model_misses", sa.Boolean, nullable=False),
        sa.Column("model", sa.String(64)),
        sa.Column("calibration", sa.String(64)),
        sa.Column("software", sa.String(50)),
        sa.Column("running_s", sa.Float),
        *(sa.Column(name, sa.Float) for name in _NUMBERS),
    )
    op.create_index("ix_cycles_part_id", "cycles", ["part_id"])
    op.create_index("by_line", "cycles", ["line", "ordered", "id"])
    op.create_index("by_time", "cycles", ["ordered", "id"])
    op.create_index("by_outcome", "cycles", ["outcome", "ordered"])
    op.create_table(
        "parameters",
        _of_cycle(),
        sa.Column("name", sa.String(100), primary_key=True),
        sa.Column("value", sa.Float, nullable=False),
        sa.Column("low", sa.Float),
        sa.Column("high", sa.Float),
    )
    op.create_table(
        "faults",
        _of_cycle(),
        sa.Column("code", sa.String(50), nullable=False),
        sa.Column("step", sa.String(50), nullable=False),
        sa.Column("device", sa.String(100)),
        sa.Column("cause", sa.Text, nullable=False),
        sa.Column("remedy", sa.Text, nullable=False),
        sa.Column("cable", sa.Text, nullable=False),
    )
    op.create_index("ix_faults_code", "faults", ["code"])
    op.create_table(
        "times",
        _of_cycle(),
        sa.Column("kind", sa.String(10), primary_key=True),
        sa.Column("name", sa.String(50), primary_key=True),
        sa.Column("seconds", sa.Float, nullable=False),
    )


def _of_cycle() -> sa.Column[int]:
    key = sa.ForeignKey("cycles.id", ondelete="CASCADE")
    return sa.Column("cycle_id", sa.Integer, key, primary_key=True)
