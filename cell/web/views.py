"""What the pages show, as plain data: pure functions of what is known of the cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.files.quantity import percent
from cell.records.ledger.ledger import ListedCycle
from cell.records.past_cycles import UNFINISHED
from cell.records.result import Outcome
from cell.run.machine import MachineEvent
from cell.web.theme import AWAY, LOOKS, N_, UNKNOWN, StateStyle
from cell.web.watching import WatchedState
from cell.web.wording import Translate

#: Words of the steps of a cycle.
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
#: Words of outcomes and of what is waited for.
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
#: Programs between the cell and the plant.
ADAPTERS = {"opcua": "OPC UA", "mqtt": "MQTT", "handshake": N_("Handshake with the PLC")}


@dataclass(frozen=True)
class FaultView:
    """A fault that waits for a person: where, why, and what can be done."""

    device: str
    step: str
    cause: str
    remedies: tuple[str, ...]


@dataclass(frozen=True)
class LiveView:
    """The live page at one moment; texts that are words of the source are still to be translated.

    buttons   commands that the present state accepts
    waiting   what the cell waits for; starts are asked for by the button itself
    fault     None = there is none to acknowledge
    adapters  troubles with the programs between the cell and the plant: name → what is wrong
    reason    why the newest cable was rejected or missed
    result    of the newest cycle: heading of a figure → its text
    unknown_s since when nothing is known of the cell, Unix time; None = it says what it does
    has_planned_time  whether the shift has one, without which there is no OEE
    """

    style: StateStyle
    step: str
    step_s: float | None
    cycle: int
    part: str
    product: str
    waiting: tuple[str, ...]
    buttons: frozenset[MachineEvent]
    fault: FaultView | None
    adapters: Mapping[str, str]
    outcome: str
    reason: str
    result: Mapping[str, str]
    counts: Mapping[str, int]
    shift: Mapping[str, str]
    reasons: tuple[tuple[str, int, str], ...]
    note: str
    folder: str
    unknown_s: float | None = None
    has_planned_time: bool = True


def live_view(seen: WatchedState, now_s: float) -> LiveView:
    """What the live page shows.

    now_s  Unix time
    """
    status, there = seen.status, seen.connected
    step = (status.step if status else None) or ""
    last = (status.last if status else None) or {}
    fault = None
    if status is not None and status.fault is not None:
        f = status.fault
        where = STEPS.get(f.step, f.step.replace("_", " "))
        fault = FaultView(f.device or "", where, f.cause, tuple(filter(None, (f.remedy, f.cable))))
    figures = seen.figures
    look = LOOKS[status.state] if status and there else AWAY
    if seen.unknown_s is not None:
        look = UNKNOWN
    return LiveView(
        style=look,
        step=STEPS.get(step, step.replace("_", " ")) if there else "",
        step_s=max(0.0, now_s - seen.step_since_s) if seen.step_since_s and there else None,
        cycle=status.cycle if status else 0,
        part=(status.part if status else None) or "",
        product=(status.product if status else None) or "",
        waiting=tuple(w for w in status.waiting_for if w != "start") if status and there else (),
        buttons=frozenset(status.possible) if status and there else frozenset(),
        fault=fault,
        adapters=adapter_troubles(status.adapters) if status and there else {},
        outcome=str(last.get("outcome", "")),
        reason=str(last.get("reason") or ""),
        result=result_figures(last),
        counts=ordered_counts(
            figures.counts if figures else status.counts if status else {},
            has_cycle=bool(step) and there,
        ),
        shift=shift_texts(seen),
        has_planned_time=figures is None or figures.is_planned,
        reasons=figures.reasons if figures else (),
        note=seen.note,
        folder=Path(str(last.get("folder", ""))).name,
        unknown_s=seen.unknown_s,
    )


def ordered_counts(counts: Mapping[str, int], *, has_cycle: bool) -> dict[str, int]:
    """Cycles by outcome, always in the same order; cycles without one are said to be what they are.

    has_cycle  whether a cycle is under way
    """
    unfinished = counts.get(UNFINISHED, 0)
    under_way = min(unfinished, int(has_cycle))
    found = {o.value: counts.get(o.value, 0) for o in Outcome}
    found |= {o: n for o, n in sorted(counts.items()) if o not in found and o != UNFINISHED}
    found |= {"under way": under_way, "broken off": unfinished - under_way}
    return {outcome: n for outcome, n in found.items() if n}


def adapter_troubles(adapters: Mapping[str, str]) -> dict[str, str]:
    """What is wrong with each program between the cell and the plant, by its name for people."""
    return {ADAPTERS.get(name, name): trouble for name, trouble in sorted(adapters.items())}


def result_figures(result: Mapping[str, Any]) -> dict[str, str]:
    """Figures of a cycle's result, as texts with units; what is not known is left out."""
    named = (
        ("predicted_miss_m", N_("Tip predicted"), 1e3, "+z.2f", "mm"),
        ("measured_miss_m", N_("Tip seen"), 1e3, "+z.2f", "mm"),
        ("margin_m", N_("Margin"), 1e3, "+z.2f", "mm"),
    )
    found = {
        heading: f"{result[key] * scale:{form}} {unit}"
        for key, heading, scale, form, unit in named
        if result.get(key) is not None
    }
    if (probability := result.get("probability")) is not None:
        found[N_("Probability")] = f"{percent(probability)} %"
    return found


def shift_texts(seen: WatchedState) -> dict[str, str]:
    """Yield and OEE of the shift, as texts; a dash where it has no meaning.

    Without a planned time there is no availability, and no OEE.
    """
    shift = seen.figures.shift if seen.figures else None
    if shift is None:
        return {}
    shares = [(N_("Yield"), shift.quality), (N_("Performance"), shift.performance)]
    if seen.figures is not None and seen.figures.is_planned:
        shares.insert(1, (N_("Availability"), shift.availability))
        shares.append((N_("OEE"), shift.oee))
    return {name: "–" if share is None else f"{share:.0%}" for name, share in shares}


def fault_texts(fault: FaultView, t: Translate) -> tuple[str, str, str]:
    """Heading, cause, and what can be done, a line each, in a language."""
    where = ", ".join(filter(None, (t(fault.device), t(fault.step))))
    return f"{t('Fault')}: {where}", t(fault.cause), "\n".join(map(t, fault.remedies))


def adapters_text(adapters: Mapping[str, str], t: Translate) -> str:
    """What is wrong with programs between the cell and the plant, a line each, in a language."""
    return "\n".join(f"{t(name)} {t(trouble)}" for name, trouble in adapters.items())


def reasons_text(reasons: Sequence[tuple[str, int, str]], t: Translate) -> str:
    """Why cables were not inserted, a line each, in a language; `reasons` as in `LiveView`."""
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


def error_chart(
    cycles: list[ListedCycle], seen: str, expected: str, not_executed: str, axis: str
) -> dict[str, Any]:
    """Errors of the forecasts over the cables, with what they expect, as an ECharts option.

    seen, expected, not_executed  names in the legend: the last is of cables rejected and failed
    axis                          name of the cables' numbers
    """
    rows = [(c, _forecast_error_mm(c)) for c in cycles if c.outcome in _CABLES]
    if all(error is None for _, error in rows):
        rows = []
    errors = [None if e is None else round(e, 4) for _, e in rows]
    limits = [
        None if e is None else round(3e3 * (c.numbers.get("predicted_std_m") or 0.0), 4)
        for c, e in rows
    ]
    band = {"type": "line", "symbol": "none", "lineStyle": {"type": "dashed", "color": "#8a94a3"}}
    return {
        "animation": False,
        "grid": {"left": 75, "right": 15, "top": 40, "bottom": 45},
        "legend": {
            "top": 0,
            "data": [seen, expected, not_executed],
            "textStyle": {"color": "#8a94a3"},
        },
        "tooltip": {"trigger": "axis"},
        "xAxis": {
            "type": "category",
            "data": [str(c.cycle) for c, _ in rows],
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
                "name": seen,
                "type": "line",
                "data": errors,
                "itemStyle": {"color": "#0b7fab"},
            },
            {**band, "name": expected, "data": limits},
            {**band, "name": f"{expected} ", "data": [None if s is None else -s for s in limits]},
            {
                "name": not_executed,
                "type": "scatter",
                "symbol": "triangle",
                "data": [0.0 if c.outcome in _NOT_EXECUTED else None for c, _ in rows],
                "itemStyle": {"color": "#b3261e"},
            },
        ],
    }


_NOT_EXECUTED = frozenset({Outcome.REJECTED, Outcome.FAILED})
#: Outcomes of cycles that were to insert a cable.
_CABLES = frozenset({Outcome.INSERTED, Outcome.MISSED, *_NOT_EXECUTED})


def _forecast_error_mm(cycle: ListedCycle) -> float | None:
    measured = cycle.numbers.get("measured_miss_m")
    predicted = cycle.numbers.get("predicted_miss_m")
    return None if measured is None or predicted is None else 1e3 * (measured - predicted)
