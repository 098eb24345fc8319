"""Content of the pages, as plain data: pure functions of the cell's state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.files.words import percent
from cell.plant.messages import FaultNotice, Status
from cell.records.folder import UNFINISHED
from cell.records.ledger.ledger import ListedCycle
from cell.records.result import Outcome
from cell.run.machine import CellState, MachineEvent
from cell.settings.model import Settings
from cell.web.theme import (
    ALARM,
    AMBER,
    AWAY,
    LOOKS,
    N_,
    NO_DATA,
    NORMAL,
    RED,
    UNKNOWN,
    WAITS,
    StateStyle,
)
from cell.web.watching import CABLES, WatchedState
from cell.web.wording import Translate

#: Titles of the pictures of a cycle, by their files' names.
PICTURES = {
    "execute_passage": N_("Insertion: path of the tip, measured and predicted"),
    "identify_still": N_("Identification: at rest before the motion"),
    "identify_swing": N_("Identification: tip at its lowest"),
    "identify_held": N_("Identification: end of the hold"),
    "measure_still": N_("Measurement: at rest before the motion"),
    "measure_swing": N_("Measurement: tip at its lowest"),
    "measure_held": N_("Measurement: end of the hold"),
}

_S = CellState
#: States without a current cycle.
_WITHOUT_CYCLE = frozenset(
    {_S.IDLE, _S.COMPLETE, _S.RESETTING, _S.STOPPED, _S.ABORTED, _S.CLEARING}
)

#: Labels of the steps of a cycle.
STEPS = {
    "warm_up": N_("compiling"),
    "connect": N_("connecting"),
    "check_paths": N_("checking the paths"),
    "reset": N_("resetting the devices"),
    "start": N_("checking that all is ready"),
    "go_home": N_("going home"),
    "grasp": N_("grasping the cable"),
    "lower": N_("lowering"),
    "hold_and_capture": N_("filming the swing"),
    "check_clocks": N_("checking the clocks"),
    "identify": N_("identifying the cable"),
    "simulate": N_("simulating motions"),
    "choose": N_("choosing a motion"),
    "execute": N_("inserting"),
    "verify": N_("verifying"),
    "bring_back": N_("bringing back"),
    "release": N_("releasing"),
}
#: Labels of outcomes and of wait reasons.
WORDS = {
    "inserted": N_("inserted"),
    "missed": N_("missed"),
    "rejected": N_("rejected"),
    "failed": N_("failed"),
    "measured": N_("measured"),
    "rehearsed": N_("rehearsed"),
    "unfit": N_("unfit"),
    UNFINISHED: N_("under way or broken off"),
    "under way": N_("under way"),
    "broken off": N_("broken off"),
    "acknowledgement": N_("an acknowledgement"),
    "unhold": N_("Continue"),
    "unsuspend": N_("the line"),
    "reset": N_("a reset"),
    "part": N_("a part"),
    "downstream": N_("the next machine"),
}
#: Definitions of the shift's figures, for a tooltip.
SHIFT_DEFINITIONS = N_(
    "ISO 22400-2: yield = good quantity / produced quantity (GQ/PQ); availability = actual "
    "production time / planned busy time (APT/PBT); performance = planned run time per item × "
    "produced quantity / actual production time (PRI·PQ/APT); OEE = their product."
)
#: One-character marks of outcomes, and their style class.
OUTCOME_MARKS: Mapping[str, tuple[str, str]] = {
    Outcome.INSERTED: ("✓", NORMAL),
    Outcome.MISSED: ("✗", WAITS),
    Outcome.REJECTED: ("–", WAITS),
    Outcome.FAILED: ("!", ALARM),
    Outcome.UNFIT: ("!", ALARM),
}
#: Programs between the cell and the plant.
ADAPTERS = {"opcua": "OPC UA", "mqtt": "MQTT", "handshake": N_("Handshake with the PLC")}


#: Status of a cell that has not connected yet, or is disconnected.
_NO_STATUS = Status("", 0, CellState.IDLE, 0.0)


@dataclass(frozen=True)
class LiveView:
    """The live page at one moment; English labels are not translated yet.

    step_share  time of the step, as a share of its last duration, at most 1
    buttons   commands that the present state accepts
    waiting   wait reasons of the cell; a wait for a start is shown by the button itself
    fault     None = there is none to acknowledge
    adapters  as of `Status`
    reason    why the newest cable was rejected or missed
    result    of the newest cycle: heading of a figure → its text
    unknown_s beginning of the time without messages, Unix time; None = the cell is connected
    newest    the newest cables, oldest first
    """

    style: StateStyle
    step: str
    step_s: float | None
    step_share: float
    cycle: int
    part: str
    product: str
    waiting: tuple[str, ...]
    buttons: frozenset[MachineEvent]
    fault: FaultNotice | None
    adapters: Mapping[str, str]
    outcome: str
    reason: str
    result: Mapping[str, str]
    counts: Mapping[str, int]
    shift: Mapping[str, str]
    note: str
    folder: str
    unknown_s: float | None = None
    newest: tuple[ListedCycle, ...] = ()


def live_view(cell: WatchedState, now_s: float) -> LiveView:
    """Content of the live page.

    now_s  Unix time
    """
    known = cell.status or _NO_STATUS
    now = known if cell.connected else _NO_STATUS
    figures, step = cell.figures, now.step or ""
    newest = figures.newest if figures else ()
    last = known.last or (newest[-1].to_json() if newest else {})
    step_s = max(0.0, now_s - cell.step_since_s) if cell.step_since_s and cell.connected else None
    usual_s = (last.get("seconds") or {}).get(step) or 0.0
    look = AWAY if now is _NO_STATUS else LOOKS[now.state]
    counts = figures.counts if figures else known.counts
    return LiveView(
        style=look if cell.unknown_s is None else UNKNOWN,
        step=step_word(step),
        step_s=step_s,
        step_share=min(1.0, step_s / usual_s) if step_s and usual_s else 0.0,
        cycle=known.cycle,
        part=known.part or "",
        product=known.product or "",
        waiting=tuple(w for w in now.waiting_for if w != "start"),
        buttons=frozenset(now.possible),
        fault=known.fault,
        adapters=now.adapters,
        outcome=str(last.get("outcome", "")),
        reason=str(last.get("reason") or ""),
        result=result_figures(last),
        counts=ordered_counts(counts, has_cycle=now.state not in _WITHOUT_CYCLE),
        shift=shift_texts(cell),
        note=cell.note,
        folder=Path(str(last.get("folder", ""))).name,
        unknown_s=cell.unknown_s,
        newest=newest,
    )


def why_disabled(event: MachineEvent, view: LiveView, *, in_control: bool) -> str:
    """Why a command is disabled, in English; "" = it is enabled."""
    if view.style.level == NO_DATA:
        return view.style.word
    if not in_control and event is not MachineEvent.STOP:
        return N_("Take control first.")
    return "" if event in view.buttons else N_("Not possible in this state.")


def ordered_counts(counts: Mapping[str, int], *, has_cycle: bool) -> dict[str, int]:
    """Number of cycles by outcome, in a fixed order; unfinished ones are current or aborted.

    has_cycle  whether there is a current cycle
    """
    unfinished = counts.get(UNFINISHED, 0)
    under_way = min(unfinished, int(has_cycle))
    ordered = {o.value: counts.get(o.value, 0) for o in Outcome}
    ordered |= {o: n for o, n in sorted(counts.items()) if o not in ordered and o != UNFINISHED}
    ordered |= {"under way": under_way, "broken off": unfinished - under_way}
    return {outcome: n for outcome, n in ordered.items() if n}


def step_word(step: str) -> str:
    """Label of a step of a cycle, in English."""
    return STEPS.get(step, step.replace("_", " "))


def result_figures(result: Mapping[str, Any]) -> dict[str, str]:
    """Figures of a cycle's result, as texts with units; unknown ones are omitted."""
    named = (
        ("predicted_miss_m", N_("Predicted miss"), 1e3, "+z.2f", "mm"),
        ("measured_miss_m", N_("Measured miss"), 1e3, "+z.2f", "mm"),
        ("margin_m", N_("Margin"), 1e3, "+z.2f", "mm"),
    )
    figures = {
        heading: f"{result[key] * scale:{form}} {unit}"
        for key, heading, scale, form, unit in named
        if result.get(key) is not None
    }
    if (probability := result.get("probability")) is not None:
        figures[N_("Probability")] = f"{percent(probability)} %"
    return figures


def shift_texts(state: WatchedState) -> dict[str, str]:
    """Yield and OEE of the shift, as texts; a dash where it has no meaning.

    Without a planned time there is no availability, and no OEE.
    """
    shift = state.figures.shift if state.figures else None
    if shift is None:
        return {}
    shares = [(N_("Yield"), shift.quality), (N_("Performance"), shift.performance)]
    if state.figures is not None and state.figures.is_planned:
        shares.insert(1, (N_("Availability"), shift.availability))
        shares.append((N_("OEE"), shift.oee))
    return {name: "–" if share is None else f"{share:.0%}" for name, share in shares}


def fault_texts(fault: FaultNotice, t: Translate) -> tuple[str, str, str]:
    """Heading, cause and remedies, a line each, in a language."""
    where = ", ".join(filter(None, (t(fault.device or ""), t(step_word(fault.step)))))
    remedies = "\n".join(map(t, filter(None, (fault.remedy, fault.cable))))
    return f"{t('Fault')}: {where}", t(fault.cause), remedies


def adapters_text(adapters: Mapping[str, str], t: Translate) -> str:
    """Failures of programs between the cell and the plant, a line each, in a language."""
    named = sorted(adapters.items())
    return "\n".join(f"{t(ADAPTERS.get(name, name))} {t(trouble)}" for name, trouble in named)


def reasons_text(reasons: Sequence[tuple[str, int, str]], t: Translate) -> str:
    """Why cables were not inserted, a line each, in a language; reasons as in `ShiftFigures`."""
    return "\n".join(f"{n} × {t(WORDS.get(code, code))}: {t(why)}" for code, n, why in reasons)


def history_row(cycle: ListedCycle, t: Translate) -> dict[str, str]:
    """A cycle as a row of the history's table, in a language."""

    def mm(key: str) -> str:
        value = cycle.numbers.get(key)
        return "" if value is None else t(f"{value * 1e3:+z.2f}")

    fault = cycle.fault
    why = t(cycle.reason or "") or ("" if fault is None else f"{fault.code}: {t(fault.cause)}")
    return {
        "name": cycle.folder.name,
        "started": f"{cycle.started:%Y-%m-%d %H:%M:%S}",
        "cycle": str(cycle.cycle),
        "part": cycle.part or "",
        "product": cycle.product or "",
        "outcome": t(WORDS.get(cycle.outcome, cycle.outcome)),
        "predicted": mm("predicted_miss_m"),
        "measured": mm("measured_miss_m"),
        "why": why,
    }


#: Labels of a chart over cables: values, their limits, cables not executed, the x axis.
ChartWords = tuple[str, str, str, str]


def error_chart(cycles: Sequence[ListedCycle], words: ChartWords) -> dict[str, Any]:
    """Errors of the forecasts over the cables, with three standard deviations on either side."""
    deviations = [c.numbers.get("predicted_std_m") or 0.0 for c in cycles]
    errors = [_forecast_error_m(c) for c in cycles]
    limits = [None if e is None else 3.0 * s for e, s in zip(errors, deviations, strict=True)]
    return _chart(cycles, errors, limits, words)


def miss_chart(
    cycles: Sequence[ListedCycle],
    words: ChartWords,
    products: Mapping[str, Settings],
    usual: Settings,
) -> dict[str, Any]:
    """Height of the tip above the opening's middle at entry, with the edges of the opening.

    products, usual  settings of each product, and those of cables without a product
    """
    misses = [c.numbers.get("measured_miss_m") for c in cycles]
    openings = [products.get(c.product or "", usual).destination.y_m for c in cycles]
    return _chart(cycles, misses, [(high - low) / 2.0 for low, high in openings], words)


def compact(chart: dict[str, Any]) -> dict[str, Any]:
    """The chart without labels and axes, for a small place."""
    grid = {"left": 60, "right": 10, "top": 8, "bottom": 8}
    axis = {**chart["xAxis"], "show": False, "name": ""}
    y_axis = {**chart["yAxis"], "splitNumber": 2}
    return {**chart, "grid": grid, "legend": {"show": False}, "xAxis": axis, "yAxis": y_axis}


def _chart(
    cycles: Sequence[ListedCycle],
    values_m: Sequence[float | None],
    limits_m: Sequence[float | None],
    words: ChartWords,
) -> dict[str, Any]:
    """Values over the cables and their limits on either side, mm, as an ECharts option.

    A value beyond its limit is red; a cable that was not executed is a triangle at 0.
    """
    rows = [
        (c, _mm(v), _mm(limit))
        for c, v, limit in zip(cycles, values_m, limits_m, strict=True)
        if c.outcome in CABLES
    ]
    if all(value is None for _, value, _ in rows):
        rows = []
    of_values, of_limits, not_executed, axis = words
    line = {"type": "line", "symbol": "none", "lineStyle": {"type": "dashed", "color": "#8a94a3"}}
    grey = {"color": "#6b7684"}
    return {
        "animation": False,
        "grid": {"left": 75, "right": 15, "top": 40, "bottom": 45},
        "legend": {"top": 0, "data": [of_values, of_limits, not_executed]},
        "tooltip": {"trigger": "axis"},
        "xAxis": {
            "type": "category",
            "data": [str(c.cycle) for c, _, _ in rows],
            "name": axis,
            "nameLocation": "middle",
            "nameGap": 26,
        },
        "yAxis": {
            "type": "value",
            "axisLabel": {"formatter": "{value} mm"},
            "splitLine": {"lineStyle": {"color": "#8a94a355"}},
        },
        "series": [
            {
                "name": of_values,
                "type": "line",
                "symbolSize": 6,
                "data": [_point(value, limit) for _, value, limit in rows],
                "lineStyle": grey,
                "itemStyle": grey,
            },
            {**line, "name": of_limits, "data": [limit for _, _, limit in rows]},
            {
                **line,
                "name": f"{of_limits} ",
                "data": [None if limit is None else -limit for _, _, limit in rows],
            },
            {
                "name": not_executed,
                "type": "scatter",
                "symbol": "triangle",
                "data": [0.0 if c.outcome in _NOT_EXECUTED else None for c, _, _ in rows],
                "itemStyle": {"color": AMBER},
            },
        ],
    }


def _point(value: float | None, limit: float | None) -> float | dict[str, Any] | None:
    if value is None or limit is None or abs(value) <= limit:
        return value
    return {"value": value, "symbolSize": 10, "itemStyle": {"color": RED}}


_NOT_EXECUTED = frozenset({Outcome.REJECTED, Outcome.FAILED})


def _forecast_error_m(cycle: ListedCycle) -> float | None:
    measured = cycle.numbers.get("measured_miss_m")
    predicted = cycle.numbers.get("predicted_miss_m")
    return None if measured is None or predicted is None else measured - predicted


def _mm(length_m: float | None) -> float | None:
    return None if length_m is None else round(1e3 * length_m, 4)
