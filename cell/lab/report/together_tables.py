"""Several studies diagnosed together: sentences, tables and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cell.files.page import page
from cell.files.table import TableData
from cell.lab.line.together_results import Consistency, Together
from cell.lab.report.wording import chance, digits

_TEMPLATES = Path(__file__).parent / "templates"


def together_parts(found: Together) -> list[str | TableData]:
    """All that is printed, in its order."""
    return [
        f"Verdict {found.verdict}: {found.why}.",
        *([_tied(found)] if found.tied else []),
        *_apart(found.consistency),
        studies_table(found),
        *([consistency_table(found.consistency)] if found.consistency else []),
        *([values_table(found.consistency)] if found.consistency else []),
        hypotheses_table(found),
    ]


def _tied(found: Together) -> str:
    others = ", ".join(" and ".join(names) for names in found.tied)
    return f"As much is explained by {others}: these studies cannot tell them apart."


def _apart(consistency: Sequence[Consistency]) -> list[str]:
    """What differs between the cables."""
    return [
        f"The cables differ in {c.parameter} by more than chance (p = {chance(c.q_p_value)})."
        for c in consistency
        if c.q_p_value < 0.01
    ]


def studies_table(found: Together) -> TableData:
    """Which studies speak for and against."""
    rows = [
        [
            part.study,
            part.alone,
            ", ".join(" or ".join(names) for names in part.missing) or "–",
            f"{part.delta_chi2:.1f}",
            "noise" if part.explained else "more than noise",
            part.says or "–",
        ]
        for part in found.studies
    ]
    heads = ["study", "verdict alone", "finds alone", "Δχ²", "what is left", "says"]
    effects = " and ".join(found.effects) or "no effect"
    note = f"Δχ², what is left and what it says: of {effects}"
    return TableData("The studies", heads, rows, (3,), note)


def consistency_table(consistency: Sequence[Consistency]) -> TableData:
    """Each parameter over all studies."""
    rows = [
        [
            c.parameter,
            f"{digits(c.value, 4)} ({digits(c.low, 4)} … {digits(c.high, 4)}) {c.unit}",
            f"{100.0 * c.tau:.1f} %" if c.logarithmic else f"{digits(c.tau, 2)} {c.unit}",
            chance(c.q_p_value),
            f"{digits(c.without_low, 4)} … {digits(c.without_high, 4)}",
        ]
        for c in consistency
    ]
    heads = ["parameter", "mean (95 %)", "between cables", "p", "without one study"]
    note = "between cables: standard deviation; p: of such differences by chance (Cochran's Q)"
    return TableData("Parameters of all cables", heads, rows, (), note)


def values_table(consistency: Sequence[Consistency]) -> TableData:
    """Each parameter by each study alone."""
    rows = [
        [value.study, *(
            f"{digits(v.value, 4)} ({digits(v.low, 4)} … {digits(v.high, 4)})"
            for v in (c.by_study[i] for c in consistency)
        )]
        for i, value in enumerate(consistency[0].by_study)
    ]  # fmt: skip
    heads = ["study", *(f"{c.parameter}, {c.unit}" for c in consistency)]
    return TableData("Parameters by study (95 %)", heads, rows)


def hypotheses_table(found: Together) -> TableData:
    """What was tried on all studies."""
    rows = [
        [" + ".join(h.effects) or "none", f"{h.evidence:.1f}", f"{h.delta_chi2:.1f}"]
        for h in found.hypotheses
    ]
    heads = ["effects", "ln evidence", "Δχ²"]
    note = "ln evidence: ln likelihood less BIC's penalty, sum over studies, beyond no effect"
    return TableData("Sets of effects, fitted to all studies", heads, rows, (1, 2), note)


def together_page(found: Together) -> str:
    """The same as a page."""
    return page(
        _TEMPLATES, "together.html", f"{len(found.studies)} studies", parts=together_parts(found)
    )
