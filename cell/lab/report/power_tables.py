"""Tables and sentences about the power of a study."""

from __future__ import annotations

from collections.abc import Iterator

from cell.files.table import TableData
from cell.lab.next.decisions import Chances
from cell.lab.next.forecast import POWER
from cell.lab.next.study_power import EffectPower, Recovery, StudyPower
from cell.lab.report.wording import parameter_in_words, size_in_digits

#: Why a diagnosis does not claim an effect, by what has to hold for it.
_GATES = {
    "significant": "it is not significant on the trials fitted to",
    "confirmed": "the held-out trials do not confirm it",
    "identified": "half of it would not be detected",
    "told_apart": "it is not told from other effects",
}
#: A probability below this is 0.00 as printed.
_SHOWN = 0.005
#: A gate that holds as surely as this limits nothing.
_SURE = 0.99


def power_table(power: StudyPower) -> TableData:
    """Size, forecast, smallest size and nearest rival of every effect."""
    rows = [
        [
            e.asked.effect.name,
            e.asked.parameter.name,
            _size(e, e.forecast.size),
            _chance(e.forecast.chances),
            _size(e, e.forecast.smallest),
            e.asked.parameter.unit,
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
    """What diagnoses of copies said; None if there were no copies."""
    tried = [(e, e.recovery) for e in power.effects if e.recovery is not None]
    if not tried:
        return None
    rows = [_recovered(e, recovery) for e, recovery in tried]
    heads = (
        *("effect", "size", "forecast", "found", "95 %", "confused"),
        *("undecided", "missed", "unexplained"),
    )
    note = (
        "Copies with the effect hidden in fresh noise, each diagnosed. “undecided”: nothing is "
        "claimed; "
        "“missed”: the model is called complete; “unexplained”: no effect explains the copy"
    )
    return TableData("Copies diagnosed", heads, rows, range(1, 9), note)


def power_sentences(power: StudyPower) -> list[str]:
    """One or two of every effect."""
    return [s for e in power.effects for s in _sentences(e)]


def _sentences(effect: EffectPower) -> Iterator[str]:
    asked, said = effect.asked, effect.forecast
    name = parameter_in_words(f"{asked.effect.name}.{asked.parameter.name}", asked.parameter.unit)
    if said.chances is None:
        yield f"No size of {name} within its bounds is found with {POWER:.0%}."
        return
    size = _size(effect, said.size)
    yield (
        f"With {name} of {size} a diagnosis finds the effect with a probability of "
        f"{said.chances.found:.2f}."
    )
    gates = {gate: getattr(said.chances, gate) for gate in _GATES}
    least = min(gates, key=lambda gate: gates[gate])
    if gates[least] < _SURE:
        yield f"If not, most often {_GATES[least]} ({1.0 - gates[least]:.2f})."
    if said.chances.confused and said.chances.confused[0][1] >= _SHOWN:
        other, chance = said.chances.confused[0]
        yield f"It is taken for {other} with a probability of {chance:.2f}."
    if effect.recovery is not None and effect.recovery.confused_with:
        others = ", ".join(f"{n} ({k})" for n, k in effect.recovery.confused_with)
        yield f"Copies were taken for {others}."


def _recovered(effect: EffectPower, recovery: Recovery) -> list[str]:
    share, low, high = recovery.share
    count = len(recovery.outcomes)
    return [
        effect.asked.effect.name,
        _size(effect, effect.forecast.size),
        _chance(effect.forecast.chances),
        f"{recovery.count('found')} of {count}, {share:.2f}",
        f"{low:.2f} … {high:.2f}",
        *(
            str(recovery.count(*said))
            for said in (("confused",), ("undecided", "failed"), ("missed",), ("unexplained",))
        ),
    ]


def _rival(effect: EffectPower) -> tuple[str, str]:
    if not effect.forecast.rivals:
        return "–", "–"
    first = effect.forecast.rivals[0]
    return first.effect, f"{first.correlation:.2f}"


def _size(effect: EffectPower, size: float | None) -> str:
    return "–" if size is None else size_in_digits(size, effect.asked.parameter.default)


def _chance(chances: Chances | None) -> str:
    return "–" if chances is None else f"{chances.found:.2f}"
