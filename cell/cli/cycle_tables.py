"""Tables about cycles for a person: results, checks, times, faults, shifts, replays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from cell.files.table import TableData
from cell.files.words import counted, percent
from cell.records.folder import UNFINISHED, PastCycle, Recorded
from cell.records.ledger.effectiveness import Shift
from cell.records.ledger.ledger import ListedCycle
from cell.records.ledger.losses import ShiftLosses, failure_times, merged, minutes_in
from cell.records.result import AgreementCheck, Outcome, Result
from cell.run.computer_check import Condition
from cell.wiring.replay import Replayed

Part = str | TableData

#: Cables that have a column of their own in the table of times.
MOST_COLUMNS = 5

_COLOURS = {
    Outcome.INSERTED: "green",
    Outcome.MISSED: "red",
    Outcome.REJECTED: "yellow",
    Outcome.FAILED: "red",
    Outcome.MEASURED: "green",
    Outcome.REHEARSED: "green",
    Outcome.UNFIT: "red",
}
#: Outcomes that need no explanation.
_GOOD = (Outcome.INSERTED, Outcome.MEASURED, Outcome.REHEARSED)
#: Outcomes whose step is shown.
_IN_STEP = (Outcome.FAILED.value, UNFINISHED)

#: SI unit → display unit, factor, and number format.
_SHOWN = {
    "m": ("mm", 1e3, ".2f"),
    "s": ("ms", 1e3, ".2f"),
    "rad": ("mrad", 1e3, ".2f"),
    "m/s": ("mm/s", 1e3, ".0f"),
    "Hz": ("Hz", 1.0, ".1f"),
    "": ("", 1.0, ".4g"),
}
#: Headings of results, right-aligned but the outcome.
_RESULT = (
    *("cable", "outcome", "offset", "predicted\nmiss", "measured\nmiss", "margin"),
    *("forecast\nerror", "passes\nwith"),
)


def results_table(results: Sequence[Result]) -> TableData:
    """One row per cable; lengths in mm."""
    rows = [
        [
            str(r.cycle),
            _outcome_text(r),
            _mm(r.offset_m, ".0f"),
            _mm(r.predicted_miss_m, "+z.2f"),
            _mm(r.measured_miss_m, "+z.2f"),
            _mm(r.margin_m, "+z.2f"),
            _mm(r.prediction_error_m, ".2f"),
            "" if r.probability is None else f"{percent(r.probability)}%",
        ]
        for r in results
    ]
    colours = {_outcome_text(r): _COLOURS[r.outcome] for r in results}
    numbers = {*range(len(_RESULT))} - {1}
    return TableData("cables (lengths in mm)", _RESULT, rows, numbers, colours=colours)


def checks_table(result: Result) -> TableData:
    """Checks of a dry run: measured values, limits, and whether they are met."""
    at = "" if result.speed is None else f" at {result.speed:.0%} of the speed"
    rows = []
    for check in result.checks:
        limits = _limits(check)
        verdict = "right" if check.right else "wrong"
        rows.append([check.what, _value_text(check), limits, verdict if limits else ""])
    title = f"dry run{at}: {result.outcome.value}"
    colours = {"right": "green", "wrong": "red"}
    return TableData(title, ["", "found", "must be", ""], rows, (1, 2), colours=colours)


def conditions_table(conditions: Sequence[Condition]) -> TableData:
    """Conditions that a cell needs of its computer: measured, needed, and whether met."""
    rows = [[c.name, c.measured, c.needed, "met" if c.met else "not met"] for c in conditions]
    colours = {"met": "green", "not met": "red"}
    return TableData("", ["condition", "here", "needed", ""], rows, colours=colours)


def seconds_table(
    results: Sequence[Result], steps: Sequence[str], *, simulated: bool = False
) -> TableData:
    """Time of each step: one column per cable, or median and longest of many cables.

    steps      names in the order of the rows; steps that few cables reach stand below
    simulated  whether the times are those of a simulated cell
    """
    many = len(results) > MOST_COLUMNS
    heads = ["median", "longest"] if many else [f"cable {r.cycle}" for r in results]
    rows: list[list[str]] = []

    def add(name: str, times_s: Sequence[float | None]) -> None:
        known = [t for t in times_s if t is not None]
        if known:
            shown = [median(known), max(known)] if many else times_s
            rows.append([name, *("" if t is None else f"{t:.3f}" for t in shown)])

    for step in dict.fromkeys([*steps, *(step for r in results for step in r.seconds)]):
        add(step.replace("_", " "), [r.seconds.get(step) for r in results])
    last_step = len(rows) - 1
    add("all", [sum(r.seconds.values()) for r in results])
    add("robot waited for the computer", [r.wait_s for r in results])
    if any(r.hold_saved_s for r in results):
        add("hold ended early by", [r.hold_saved_s for r in results])
    columns = range(1, 1 + len(heads))
    time = "simulated seconds" if simulated else "seconds"
    return TableData(f"{time} per step", ["step", *heads], rows, columns, ends=(last_step,))


def troubles(results: Sequence[Result]) -> list[str]:
    """One line for every cable that was not inserted: why, and what to do."""
    lines = []
    for r in results:
        if r.fault is not None:
            device = f"{r.fault.device}: " if r.fault.device else ""
            remedy = f"; {r.fault.remedy}" if r.fault.remedy else ""
            cable = f"; {r.fault.cable}" if r.fault.cable else ""
            lines.append(
                f"cable {r.cycle} failed in step {r.fault.step}: "
                f"{device}{r.fault.cause}{remedy}{cable}"
            )
        elif r.outcome is Outcome.UNFIT:
            lines += [f"{c.what}: {_value_text(c)}; {c.remedy}" for c in r.checks if not c.right]
        elif r.outcome not in _GOOD:
            lines.append(f"cable {r.cycle} {r.outcome.value}: {r.reason}")
    return lines


def parameters_table(model: Mapping[str, Any]) -> TableData:
    """A cable's parameters with their 95 % intervals; `model` as `Identified.to_dict` gives it."""
    rows = [
        [p["name"], *(f"{p[key]:.4g}" for key in ("value", "low", "high")), p["unit"]]
        for p in model["parameters"]
    ]
    heads = ["parameter", "value", "95 % from", "to", "unit"]
    return TableData("parameters", heads, rows, (1, 2, 3))


def history_table(past: Sequence[PastCycle]) -> TableData:
    """One row per cycle; lengths in mm."""
    rows = [
        [
            p.folder.name,
            f"{p.outcome} in step {p.step}" if p.outcome in _IN_STEP else p.outcome,
            _mm(p.offset_m, ".0f"),
            _mm(p.prediction_error_m, ".2f"),
            str(len(p.pictures)) if p.pictures else "",
        ]
        for p in past
    ]
    heads = ["folder", "outcome", "offset", "forecast\nerror", "pictures"]
    return TableData("cycles (lengths in mm)", heads, rows, (2, 3, 4))


def record_parts(record: Recorded, pictures: Sequence[Path]) -> list[Part]:
    """A cycle's result, why it ended, its parameters and times, and where its pictures are."""
    result = record.result
    if result is None:
        parts: list[Part] = [
            f"{record.folder}: ended without a result in step {record.step}; "
            "it still runs or was killed"
        ]
    else:
        table = checks_table(result) if result.checks else results_table([result])
        parts = [table, *troubles([result])]
        if record.model is not None:
            parts.append(parameters_table(record.model))
        parts.append(seconds_table([result], list(result.seconds)))
    study = ["study"] if record.study is not None else []
    return [*parts, *(f"{record.folder / name}" for name in (*study, *(p.name for p in pictures)))]


def cycles_parts(cycles: Sequence[ListedCycle], counts: Mapping[str, int]) -> list[Part]:
    """One row per cycle, lengths in mm; how many there are in all, by outcome."""
    total = sum(counts.values())
    if not total:
        return ["no such cycle is listed"]
    optional: dict[str, list[str]] = {
        "line": [c.line for c in cycles] if len({c.line for c in cycles}) > 1 else [],
        "product": [c.product or "" for c in cycles] if any(c.product for c in cycles) else [],
        "part": [c.part or "" for c in cycles] if any(c.part for c in cycles) else [],
    }
    shown = {name: column for name, column in optional.items() if column}
    rows = [
        [
            f"{c.started:%Y-%m-%d %H:%M:%S}",
            *(column[i] for column in shown.values()),
            _listed_outcome(c),
            _mm(c.numbers["offset_m"], ".0f"),
            _mm(c.numbers["measured_miss_m"], ".2f"),
            _mm(c.numbers["predicted_miss_m"], ".2f"),
            "" if c.running_s is None else f"{c.running_s:.1f}",
        ]
        for i, c in enumerate(cycles)
    ]
    columns = ["begun", *shown, "outcome"]
    heads = [*columns, "offset", "miss", "expected", "s"]
    table = TableData("cycles (lengths in mm)", heads, rows, range(len(columns), len(heads)))
    by_outcome = ", ".join(f"{n} {outcome}" for outcome, n in sorted(counts.items()))
    more = "" if total == len(cycles) else f", the newest {len(cycles)} above"
    return [table, f"{total} {'cycles' if total > 1 else 'cycle'}: {by_outcome}{more}"]


def faults_parts(faults: Sequence[tuple[str, int, str]]) -> list[Part]:
    """One row per code, the most frequent first."""
    if not faults:
        return ["no cycle was ended by a fault"]
    rows = [[code, cause, str(number)] for code, number, cause in faults]
    return [TableData("faults", ["code", "newest cause", "cycles"], rows, (2,))]


def shifts_parts(shifts: Sequence[Shift]) -> list[Part]:
    """One row per shift, shares in %."""
    if not shifts:
        return ["no shift with a cable to be inserted"]
    rows = []
    for s in shifts:
        shares = (s.availability, s.performance, s.quality, s.oee)
        rows.append(
            [
                f"{s.begin:%Y-%m-%d %H:%M} to {s.end:%H:%M}",
                *(str(s.cables), str(s.inserted)),
                *("" if share is None else f"{100.0 * share:.1f}" for share in shares),
            ]
        )
    heads = ["shift", "cables", "inserted", "availability", "performance", "quality", "OEE"]
    parts: list[Part] = [TableData("shifts (shares in %)", heads, rows, range(1, len(heads)))]
    if (ideal_s := shifts[0].ideal_s) is not None:
        parts.append(f"a cable needs {ideal_s:.1f} s at best")
    if any(s.availability is None for s in shifts):
        parts.append("no availability: simulated time is not the clock's")
    return parts


def losses_parts(
    shifts: Sequence[ShiftLosses], begins: Sequence[str], *, chosen: bool
) -> list[Part]:
    """One row per cause of lost time, the longest first; and where all planned time went.

    begins  local times at which shifts begin
    chosen  whether the settings name them: else they are the default
    """
    if not shifts:
        return ["no shift in which the cell ran"]
    planned_min = sum(minutes_in(s.planned) for s in shifts)
    productive_min = sum(minutes_in(s.productive) for s in shifts)
    rows = []
    for loss in merged(shifts):
        minutes = minutes_in(loss.lasted)
        rows.append(
            [
                loss.text,
                f"{minutes:.1f}",
                f"{100.0 * minutes / planned_min:.1f}",
                str(len(loss.cycles)) if loss.cycles else "",
                "; ".join(filter(None, (loss.evidence, loss.physics))),
            ]
        )
    heads = ["cause", "minutes", "%", "cycles", "evidence"]
    failures = [
        [f.code, str(f.failures), *(f"{minutes_in(mean):.1f}" for mean in (f.mtbf, f.mttr))]
        for f in failure_times(shifts)
    ]
    means = ["code", "failures", "MTBF, min", "MTTR, min"]
    inserted = sum(s.inserted for s in shifts)
    first, last = (t.astimezone() for t in (shifts[0].begin, max(s.end for s in shifts)))
    source = "`ledger.shifts`" if chosen else "default of `ledger.shifts`"
    return [
        TableData("lost time", heads, rows, (1, 2, 3)),
        *([TableData("failures", means, failures, (1, 2, 3))] if failures else []),
        f"{planned_min:.1f} min planned in {counted(len(shifts), 'shift')}: "
        f"{productive_min:.1f} min of inserted cables ({inserted}), "
        f"{planned_min - productive_min:.1f} min lost",
        f"shifts from {', '.join(begins)} ({source}); these are from {first:%Y-%m-%d %H:%M} to "
        f"{last:%Y-%m-%d %H:%M}",
    ]


def replayed_parts(replayed: Replayed, most: int) -> Iterator[Part]:
    """Whether a replay gave the same, and `most` of the differences, the largest first."""
    yield from replayed.losses
    result, differences = replayed.result, replayed.differences
    if not replayed.complete:
        yield "the recording ends before its cycle does"
    if result.fault is not None:
        yield f"the replay ended in step {result.fault.step}: {result.fault.cause}"
    if not replayed.decided:
        yield "nothing was decided in this cycle: only what came before is compared"
    for name, (then, now) in replayed.software.items():
        yield f"{name} was {then}, now {now}"
    if not differences:
        complete = replayed.complete and not replayed.losses
        compared = result.outcome.value if complete else "what it holds"
        yield f"identical: {compared}, every number to the last bit"
        return
    rows = [[d.name, _short(d.then), _short(d.now)] for d in differences[:most]]
    yield TableData("differences", ["what", "then", "now"], rows)
    if len(differences) > most:
        yield f"and {len(differences) - most} more; --json has all"


def imported_parts(result: Result) -> Iterator[Part]:
    """What was identified in an imported film."""
    if result.fault is not None:
        yield f"the film ended in step {result.fault.step}: {result.fault.cause}"
        return
    if result.parameters:
        rows = [[name, f"{value:.4g}"] for name, value in result.parameters.items()]
        yield TableData("this cable (SI units)", ["parameter", "value"], rows, (1,))
    if result.reason is not None:
        yield f"{result.outcome.value}: {result.reason}"
    if result.residual_rms_m is not None:
        yield f"what the model leaves: {result.residual_rms_m * 1e3:.3f} mm rms"
    if result.offset_m is not None:
        yield f"it would be inserted with an offset of {result.offset_m * 1e3:.0f} mm"


def _outcome_text(result: Result) -> str:
    """Outcome, with the number of the attempt if the cable was stopped before the opening."""
    tries = f", try {len(result.stops) + 1}" if result.stops else ""
    return f"{result.outcome.value}{tries}"


def _listed_outcome(cycle: ListedCycle) -> str:
    """Outcome, with the fault's code, and a mark on a fault that nobody has acknowledged."""
    if cycle.fault is None:
        return cycle.outcome
    return f"{cycle.outcome}: {cycle.fault.code}{'' if cycle.acknowledged else ' (open)'}"


def _mm(length_m: float | None, form: str) -> str:
    return "" if length_m is None else format(length_m * 1e3, form)


def _value_text(check: AgreementCheck) -> str:
    unit, factor, form = _SHOWN[check.unit]
    return f"{check.found * factor:{form}} {unit}".rstrip()


def _limits(check: AgreementCheck) -> str:
    unit, factor, _ = _SHOWN[check.unit]
    low, high = (None if v is None else f"{v * factor:g}" for v in (check.low, check.high))
    if low is None or high is None:
        words = "" if low is high else f"≥ {low}" if high is None else f"≤ {high}"
    else:
        words = f"{low} … {high}"
    return f"{words} {unit}".strip() if words else ""


def _short(value: Any) -> str:
    """A value in a table: numbers with all their digits, the rest cut."""
    if value is None:
        return "none"
    if isinstance(value, int | float | bool):
        return repr(value)
    text = str(value)
    return text if len(text) <= 30 else f"{text[:27]}..."
