"""What Prometheus reads, and what the dashboard for Grafana asks of it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.openmetrics.exposition import generate_latest
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from cell.plant.messages import FaultNotice, Status
from cell.records.ledger.effectiveness import Shift
from cell.run.machine import CellState
from cell.web.metrics import metrics_of
from cell.web.watching import ShiftFigures, WatchedState

DASHBOARD = Path(__file__).parents[3] / "config" / "grafana.json"
LAST = {
    **{"cycle": 7, "outcome": "inserted", "measured_miss_m": 3e-4, "predicted_miss_m": 1e-4},
    **{"predicted_std_m": 5e-5, "margin_m": 8e-4, "probability": 0.99, "wait_s": 1.2},
    **{"residual_rms_m": 1e-4, "noise_m": 8e-5},
}
STATUS = Status(
    "r", 3, CellState.EXECUTE, 1.0, cycle=8, last=LAST, counts={"inserted": 6, "failed": 1},
    state_seconds={"execute": 90.5}, adapters={"mqtt": "has ended"},
    fault=FaultNotice(6, "grasp", "no cable", 2.0, "gripper", code="gripper.empty"),
)  # fmt: skip
BEGIN = datetime(2026, 1, 5, 6, tzinfo=UTC)
SHIFT = Shift(BEGIN, BEGIN.replace(hour=14), 3600.0, 1800.0, 12.0, 7, 6)
SEEN = WatchedState(STATUS, connected=True, figures=ShiftFigures({}, SHIFT, ()))


def samples(seen: WatchedState) -> dict[tuple[str, ...], float]:
    """Name and values of the labels → value, as an independent parser reads the exposition."""

    class Once(Collector):
        def collect(self):
            return metrics_of(seen)

    registry = CollectorRegistry()
    registry.register(Once())
    families = text_string_to_metric_families(generate_latest(registry).decode())
    return {(s.name, *s.labels.values()): s.value for f in families for s in f.samples}


def test_state_counts_and_the_last_cycle_are_read() -> None:
    read = samples(SEEN)
    assert read["cell_connected",] == 1.0
    assert read["cell_state", "execute"] == 1.0 and read["cell_state", "idle"] == 0.0
    assert read["cell_cycles_total", "inserted"] == 6.0
    assert read["cell_state_seconds_total", "execute"] == 90.5
    assert read["cell_fault", "gripper.empty", "gripper", "grasp"] == 1.0
    assert (
        read["cell_adapter_trouble", "mqtt"] == 1.0 and read["cell_adapter_trouble", "opcua"] == 0
    )
    assert read["cell_forecast_error_meters",] == pytest.approx(2e-4)
    assert read["cell_wait_seconds",] == 1.2
    assert read["cell_shift_ratio", "availability"] == 0.5
    assert read["cell_last_cycle",] == 7.0


def test_of_a_cell_that_is_away_nothing_old_is_told() -> None:
    assert samples(replace(SEEN, connected=False)) == {("cell_connected",): 0.0}
    assert samples(WatchedState()) == {("cell_connected",): 0.0}


def test_what_is_not_known_is_left_out() -> None:
    rejected = {"cycle": 8, "outcome": "rejected", "predicted_miss_m": 1e-4}
    read = samples(replace(SEEN, status=replace(STATUS, last=rejected), figures=None))
    assert ("cell_predicted_tip_miss_meters",) in read
    assert not {name for name, *_ in read} & {"cell_tip_miss_meters", "cell_forecast_error_meters"}


def test_the_dashboard_asks_for_what_there_is() -> None:
    dashboard = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    queries = [t["expr"] for panel in dashboard["panels"] for t in panel["targets"]]
    queries += [
        v["query"]["query"] for v in dashboard["templating"]["list"] if v["type"] == "query"
    ]
    asked = {name for query in queries for name in re.findall(r"\bcell_\w+", query)}
    labels = {label for query in queries for label in re.findall(r"by \((\w+)\)", query)}
    known = {name for name, *_ in samples(SEEN)}
    assert asked <= known and len(asked) >= 12
    assert labels == {"outcome"}
