"""Metrics of a cell for Prometheus: state, cycles by outcome, figures of the last cycle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    Metric,
    StateSetMetricFamily,
)
from prometheus_client.registry import Collector

from cell.plant.messages import Status
from cell.run.machine import CellState
from cell.web.views import ADAPTERS
from cell.web.watching import CellWatch, WatchedState

#: Figures of the last cycle, SI units: name, description, key of the result.
_LAST = (
    ("cell_tip_miss_meters", "Measured height of the tip above the opening's middle at entry",
     "measured_miss_m"),
    ("cell_predicted_tip_miss_meters", "The same, predicted", "predicted_miss_m"),
    ("cell_predicted_margin_std_meters", "Standard deviation of the predicted margin",
     "predicted_std_m"),
    ("cell_margin_meters", "Smallest measured distance of the tip to the opening's edges",
     "margin_m"),
    ("cell_insertion_probability_ratio", "Predicted probability of passing", "probability"),
    ("cell_fit_residual_meters", "Root mean square of the fit's residual", "residual_rms_m"),
    ("cell_marker_noise_meters", "Noise of the detected markers", "noise_m"),
    ("cell_wait_seconds", "Time in which the robot waited for the computer", "wait_s"),
)  # fmt: skip
_SHIFT = ("quality", "performance", "availability", "oee")


class CellMetrics(Collector):
    """Metrics of a watched cell, collected at each request."""

    def __init__(self, watch: CellWatch) -> None:
        self._watch = watch
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def collect(self) -> Iterator[Metric]:
        """Metrics for Prometheus' registry."""
        return metrics_of(self._watch.state)

    def exposition(self, accepted: str) -> tuple[bytes, str]:
        """Body and content type of an answer; `accepted` = the request's `Accept` header."""
        encode, content_type = choose_encoder(accepted)
        return encode(self._registry), content_type


def metrics_of(state: WatchedState) -> Iterator[Metric]:
    """Metrics at one moment; for a disconnected cell only `cell_connected`."""
    yield GaugeMetricFamily("cell_connected", "Whether a cell runs", float(state.connected))
    status = state.status
    if status is None or not state.connected:
        return
    yield from _of_status(status)
    yield from _of_last(status.last or {})
    shift = state.figures.shift if state.figures else None
    shares = GaugeMetricFamily("cell_shift_ratio", "Shares of ISO 22400-2", labels=["share"])
    for name in _SHIFT:
        if (share := getattr(shift, name, None)) is not None:
            shares.add_metric([name], share)
    yield shares


def _of_status(status: Status) -> Iterator[Metric]:
    states = {state.value: state is status.state for state in CellState}
    yield StateSetMetricFamily("cell_state", "State of the cell, after PackML", states)
    cycles = CounterMetricFamily("cell_cycles", "Cycles of this run", labels=["outcome"])
    for outcome, count in status.counts.items():
        cycles.add_metric([outcome], count)
    yield cycles
    time_in = CounterMetricFamily(
        "cell_state_seconds", "Time spent in each state in this run", labels=["state"]
    )
    for state, seconds in status.state_seconds.items():
        time_in.add_metric([state], seconds)
    yield time_in
    faults = GaugeMetricFamily(
        "cell_fault", "A fault that nobody has acknowledged", labels=["code", "device", "step"]
    )
    if (fault := status.fault) is not None:
        faults.add_metric([fault.code, fault.device or "", fault.step], 1.0)
    yield faults
    adapters = GaugeMetricFamily(
        "cell_adapter_trouble", "Whether an adapter of the plant has ended", labels=["adapter"]
    )
    for adapter in sorted({*ADAPTERS, *status.adapters}):
        adapters.add_metric([adapter], float(adapter in status.adapters))
    yield adapters


def _of_last(last: Mapping[str, Any]) -> Iterator[Metric]:
    for name, text, key in _LAST:
        if (value := last.get(key)) is not None:
            yield GaugeMetricFamily(name, f"{text}; last cycle", value)
    measured, predicted = last.get("measured_miss_m"), last.get("predicted_miss_m")
    if measured is not None and predicted is not None:
        yield GaugeMetricFamily(
            "cell_forecast_error_meters",
            "Measured minus predicted height of the tip; last cycle",
            measured - predicted,
        )
    if last:
        yield GaugeMetricFamily("cell_last_cycle", "Number of the last cycle", last["cycle"])
