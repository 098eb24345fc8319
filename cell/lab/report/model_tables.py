"""Tables and sentences about models: their parameters, comparisons, effects, laws, suggestions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cell.cable.effects.base import Effect
from cell.cable.effects.check import passed_checks
from cell.files.table import TableData
from cell.files.words import counted
from cell.identify.identified import Identified
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Errors
from cell.lab.next.decisions import Chances
from cell.lab.next.study_power import POWER, EffectPower, Recovery, StudyPower
from cell.lab.report.tables import NOISE_ALONE
from cell.lab.report.wording import (
    chance,
    correlation,
    digits,
    mm,
    noise_label,
    parameter_in_words,
    short,
    size_in_digits,
)
from cell.lab.strength.compare import NOTICEABLE, Comparison

_ERROR = "Error, mm rms per coordinate"
_INTERVAL_HEADS = ("parameter", "value", "low", "high", "unit")

if TYPE_CHECKING:
    from cell.lab.next.discover import Discovery
    from cell.lab.next.motion_file import Suggestion


def model_table(model: Identified, fitted_to: str = "") -> TableData:
    """Parameters with 95 % intervals.

    fitted_to  the data behind them, for the title
    """
    low, high = model.interval()
    columns = (model.space.names, model.values, low, high, model.space.units)
    rows = [
        [name, digits(value, 4), digits(lo, 4), digits(hi, 4), unit]
        for name, value, lo, hi, unit in zip(*columns, strict=True)
    ]
    title = f"Parameters, 95 % intervals{fitted_to and f', from {fitted_to}'}"
    return TableData(title, _INTERVAL_HEADS, rows, (1, 2, 3))


def errors_line(prepared: PreparedStudy, errors: Errors) -> str:
    """Text: fitted and held-out error, and the noise."""
    return (
        f"error {mm(errors.fit_rms_m)} mm fitted, {mm(errors.heldout_rms_m)} mm held out, "
        f"{noise_label(prepared.study.noise_std_m is not None)} "
        f"{mm(prepared.noise_model.noise.std_m)} mm (rms per coordinate)"
    )


def comparison_sentence(comparisons: Sequence[Comparison]) -> str:
    """Sentence that compares the errors of models, from the first to the last."""
    first, last = comparisons[0], comparisons[-1]
    held = not np.isnan(first.heldout_rms_m)
    where = "motions not fitted to" if held else "the motions fitted to"
    noise = f"the {noise_label(first.noise_is_stated)} is {short(first.noise_m * 1e3)} mm"
    if first is last:
        beyond = f" and {short(last.heldout_rms_m * 1e3)} mm on motions not fitted to"
        return (
            f"The model misses {short(last.fit_rms_m * 1e3)} mm on the motions fitted to"
            f"{beyond if held else ''}; {noise}."
        )
    errors = [f"{1e3 * c.error_m:#.3g}" for c in comparisons]
    before, after = errors[0], errors[-1]
    goes = f"{'falls' if last.error_m < first.error_m else 'rises'} from {before} to {after} mm"
    if before == after:
        goes = f"stays at {after} mm"
    between = [f"“{c.model}” {e} mm" for c, e in zip(comparisons, errors, strict=True)][1:-1]
    among = f" (between them: {', '.join(between)})" if between else ""
    return f"From “{first.model}” to “{last.model}” the error on {where} {goes}{among}; {noise}."


def comparisons_table(comparisons: Sequence[Comparison]) -> TableData:
    """Errors of models side by side, trial by trial."""
    trials = comparisons[0].study.trials
    rows = [
        [trial.name, trial.role, *(mm(c.where[i].rms_m) for c in comparisons)]
        for i, trial in enumerate(trials)
    ]
    rows += [
        ["fitted", "", *(mm(c.fit_rms_m) for c in comparisons)],
        ["held out", "", *(mm(c.heldout_rms_m) for c in comparisons)],
        [noise_label(comparisons[0].noise_is_stated), "", *(mm(c.noise_m) for c in comparisons)],
        ["effects", "", *("\n".join(c.effects) or "–" for c in comparisons)],
    ]
    heads = ["trial", "role", *(c.model for c in comparisons)]
    numbers = range(2, len(heads))
    return TableData(_ERROR, heads, rows, numbers, ends=(len(trials) - 1,))


def comparison_table(comparison: Comparison) -> TableData:
    """Error of each trial, by phase."""
    phases = list(comparison.where[0].by_phase)
    rows = [
        [
            trial.name,
            trial.role,
            mm(w.rms_m),
            *(mm(w.by_phase[p]) for p in phases),
            chance(w.whiteness_p_value),
        ]
        for trial, w in zip(comparison.study.trials, comparison.where, strict=True)
    ]
    blank = [""] * (len(phases) + 1)
    rows += [
        [name, "", mm(value_m), *blank]
        for name, value_m in (
            ("fitted", comparison.fit_rms_m),
            ("held out", comparison.heldout_rms_m),
            (noise_label(comparison.noise_is_stated), comparison.noise_m),
        )
    ]
    heads = ["trial", "role", "all", *phases, "p (white)"]
    return TableData(_ERROR, heads, rows, range(2, len(heads)))


def correlations_table(comparison: Comparison) -> TableData:
    """Correlations of the tip's residual with signals, by trial."""
    names = sorted({f.signal for w in comparison.where for f in w.correlations})
    rows = []
    for w in comparison.where:
        shown = {
            f.signal: f"{correlation(f.correlation)}{'*' if f.p_value < NOTICEABLE else ''}"
            for f in w.correlations
        }
        rows.append([w.trial, *(shown.get(n, "") for n in names)])
    heads = ["trial", *names]
    return TableData("Correlation of the tip's residual", heads, rows, range(1, len(heads)))


def effects_table(library: Mapping[str, type[Effect]]) -> TableData:
    """Names, laws and parameters of effects."""
    rows = [
        [
            name,
            " ".join((effect.__doc__ or "").split("\n\n")[0].split()),
            "\n".join(
                f"{p.name} [{p.unit}] {p.low:g} … {p.high:g}" for p in effect.parameters if p.fitted
            ),
        ]
        for name, effect in library.items()
    ]
    return TableData("", ["effect", "law", "parameters"], rows)


def passed_line(effect: type[Effect]) -> str:
    """Text: the checks that a user's own effect has passed."""
    passed = passed_checks(effect)
    return f"{effect.name}: {counted(len(passed), 'check')} passed: {'; '.join(passed)}"


def describe_effects(library: Mapping[str, type[Effect]]) -> list[dict[str, Any]]:
    """Names, laws and parameters of effects, as plain data."""
    return [
        {
            "effect": name,
            "law": " ".join((effect.__doc__ or "").split()),
            "parameters": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "low": p.low,
                    "high": p.high,
                    "typical": p.starts[0],
                }
                for p in effect.parameters
            ],
        }
        for name, effect in library.items()
    ]


def discovery_table(discovery: Discovery) -> TableData:
    """Numbers of the law."""
    rows = [
        [name, digits(p.value, 4), digits(p.low, 4), digits(p.high, 4), p.unit]
        for name, p in discovery.parameters.items()
    ]
    return TableData("Discovered law", _INTERVAL_HEADS, rows, (1, 2, 3))


def discovery_sentence(discovery: Discovery) -> str:
    """Sentence on the error with and without a discovered law."""
    where = "held-out error" if discovery.confirmed else "error on the trials fitted to"
    times = discovery.after_m / discovery.noise_m
    remainder = "What is left is noise."
    if not discovery.complete:
        remainder = f"What is left is {times:.1f} times the noise: another effect is missing too."
    elif times > NOISE_ALONE:
        remainder = f"What is left is {times:.1f} times the noise: small, but more than noise."
    doubt = "No trial of another motion is held out: the law is not confirmed."
    closing = remainder if discovery.confirmed else f"{remainder} {doubt}"
    return (
        f"With {discovery.effect} the {where} falls from {mm(discovery.before_m)} to "
        f"{mm(discovery.after_m)} mm, noise {mm(discovery.noise_m)} mm. {closing}"
    )


def suggestion_table(suggestion: Suggestion) -> TableData:
    """Table of the suggested motions and how well each distinguishes the candidates."""
    rows = [
        [o.motion.describe(), f"{o.separation:.1f}", o.hardest, f"{o.power:.2f}"]
        for o in suggestion.options[:5]
    ]
    first, *rivals = suggestion.candidates
    note = f"distinguishes {first} from {', '.join(rivals)}; {_respected_limits(suggestion)}"
    heads = ["motion", "separation χ²", "hardest to distinguish", "power"]
    return TableData("Suggested motion, and the next best", heads, rows, (1, 3), note)


def _respected_limits(suggestion: Suggestion) -> str:
    """Text: the limits that the motions respect, and the number of motions refused."""
    refused = sum(suggestion.refused.values())
    low, high = np.degrees(suggestion.surroundings.angle_rad)
    angles = f"clamp angles from {low:.0f} to {high:.0f}°"
    if suggestion.surroundings.picture_m is None:
        return (
            f"checked only against a box of ±100 mm around home and {angles}: give --config for "
            "the limits, the picture and the workpiece of a cell; its `limits.angle_rad` narrows "
            "the angles"
        )
    return (
        f"gripper within its limits, {angles} (`limits.angle_rad`), cable and jaw in the "
        f"picture, cable clear of the workpiece, all including the uncertainty of the "
        f"cable; {refused} motions refused"
    )


#: Why a diagnosis does not claim an effect, by the condition that fails.
_GATES = {
    "significant": "it is not significant on the trials fitted to",
    "confirmed": "the held-out trials do not confirm it",
    "identified": "half of it would not be detected",
    "told_apart": "it is not told from other effects",
}
#: A probability below this is 0.00 as printed.
_SHOWN = 0.005
#: Probability above which a gate is no limitation.
_SURE = 0.99


def power_table(power: StudyPower) -> TableData:
    """Size, forecast, smallest size and nearest rival of every effect."""
    rows = [
        [
            e.query.effect.name,
            e.query.parameter.name,
            _size(e, e.size),
            _chance(e.chances),
            _size(e, e.smallest),
            e.query.parameter.unit,
            *_rival(e),
        ]
        for e in power.effects
    ]
    heads = ("effect", "parameter", "size", "found", f"found {POWER:.0%}", "unit", "most like", "r")
    note = (
        "“found”: probability that `cell diagnose` claims the effect; "
        f"“found {POWER:.0%}”: the smallest size with that probability, “–”: none within bounds; "
        "“r”: correlation of what both effects do to the markers that no parameter imitates"
    )
    return TableData("Power, forecast near the fitted model", heads, rows, (2, 3, 4, 7), note)


def recovery_table(power: StudyPower) -> TableData | None:
    """Table of the copies' diagnoses; None if there were no copies."""
    diagnosed = [(e, e.recovery) for e in power.effects if e.recovery is not None]
    if not diagnosed:
        return None
    rows = [_recovered(e, recovery) for e, recovery in diagnosed]
    heads = (
        *("effect", "size", "forecast", "found", "95 %", "confused"),
        *("undecided", "missed", "unexplained"),
    )
    note = (
        "Copies with the effect hidden in fresh noise, each diagnosed. “undecided”: nothing is "
        "claimed; “missed”: the model is called complete; “unexplained”: no effect explains the "
        "copy"
    )
    return TableData("Copies diagnosed", heads, rows, range(1, 9), note)


def power_sentences(power: StudyPower) -> list[str]:
    """Sentences on every effect's power."""
    return [s for e in power.effects for s in _sentences(e)]


def _sentences(effect: EffectPower) -> Iterator[str]:
    query, chances = effect.query, effect.chances
    name = parameter_in_words(f"{query.effect.name}.{query.parameter.name}", query.parameter.unit)
    if chances is None:
        yield f"No size of {name} within its bounds is found with {POWER:.0%}."
        return
    size = _size(effect, effect.size)
    yield (
        f"With {name} of {size} a diagnosis finds the effect with a probability of "
        f"{chances.found:.2f}."
    )
    gates = {gate: getattr(chances, gate) for gate in _GATES}
    least = min(gates, key=lambda gate: gates[gate])
    if gates[least] < _SURE:
        yield f"If not, most often {_GATES[least]} ({1.0 - gates[least]:.2f})."
    if chances.confused and chances.confused[0][1] >= _SHOWN:
        rival, p = chances.confused[0]
        yield f"It is taken for {rival} with a probability of {p:.2f}."
    if effect.recovery is not None and effect.recovery.confused_with:
        rivals = ", ".join(f"{n} ({k})" for n, k in effect.recovery.confused_with)
        yield f"Copies were taken for {rivals}."


def _recovered(effect: EffectPower, recovery: Recovery) -> list[str]:
    share, low, high = recovery.share
    count = len(recovery.outcomes)
    return [
        effect.query.effect.name,
        _size(effect, effect.size),
        _chance(effect.chances),
        f"{recovery.count('found')} of {count}, {share:.2f}",
        f"{low:.2f} … {high:.2f}",
        *(
            str(recovery.count(*outcomes))
            for outcomes in (("confused",), ("undecided", "failed"), ("missed",), ("unexplained",))
        ),
    ]


def _rival(effect: EffectPower) -> tuple[str, str]:
    if not effect.rivals:
        return "–", "–"
    first = effect.rivals[0]
    return first.effect, f"{first.correlation:.2f}"


def _size(effect: EffectPower, size: float | None) -> str:
    return "–" if size is None else size_in_digits(size, effect.query.parameter.default)


def _chance(chances: Chances | None) -> str:
    return "–" if chances is None else f"{chances.found:.2f}"
