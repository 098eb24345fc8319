"""The result of `cell learn` as sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.files.page import page
from cell.files.table import TableData
from cell.files.words import counted
from cell.lab.data.check import CheckOutcome
from cell.lab.data.results import Verdict
from cell.lab.line.effect_fit import LearningResult
from cell.lab.line.forecasts import ForecastPair
from cell.lab.line.identify_all import IdentifiedAll
from cell.lab.line.learn import NEGLIGIBLE_M, negligible
from cell.lab.line.learning_checks import LineEvidence, learning_outcomes, learning_verdict
from cell.lab.line.together import Consistency, Together
from cell.lab.report.tables import check_rows, checks_table
from cell.lab.report.wording import chance, digits, with_interval
from cell.records.model_errors import FEWEST, interval

#: Hint where no effect of the library explains the error.
LAWS = "`cell learn --laws` looks for a law that is not in the library"

#: What the verdict of `cell learn` means.
LEARNING_VERDICTS: dict[Verdict, str] = {
    "complete": "these cycles show no missing effect",
    "missing": "the effect named is missing in the model; the gates say whether it helps the line",
    "unexplained": "the model lacks an effect, and none that was tried explains the error",
    "cannot_tell": "these cycles cannot decide whether the model lacks an effect, or which one",
}


def learning_lines(result: LearningResult, *, so_far: bool = False) -> list[str]:
    """Sentences: the missing effects, the share of the error they explain, and their evidence.

    so_far  the search for effects was interrupted
    """
    before_m, noise_m = result.baseline.rms_m, result.baseline.noise_m
    first = (
        f"{counted(len(result.cycles), 'cable')}: the model misses {before_m * 1e3:.3f} mm rms, "
        f"the {_noise_name(result)} is {noise_m * 1e3:.3f} mm"
    )
    if result.best is None and so_far:
        return [first, "the missing effect is not identified yet; nothing was written"]
    if result.best is None:
        return [first, _without_effect(result)]
    best, lines = result.best, [first]
    natural = best.fit.natural()[best.fit.common]
    values = ", ".join(
        f"{name.partition('.')[2]} {value:.4g} {best.fit.space.units[i]}".removesuffix(" 1")
        for name, value, i in zip(best.names, natural, best.fit.common, strict=True)
    )
    lines.append(
        f"missing: {best.name} ({values}), {_p_text(best.p_value)}; with it the model misses "
        f"{best.fit.rms_m * 1e3:.3f} mm"
    )
    if result.tied:
        lines.append(f"these cycles cannot distinguish it from: {', '.join(result.tied)}")
    for i, s in zip(best.firsts, result.spread, strict=True):
        if s.dof > 0:
            lines.append(
                f"{best.names[i]} differs between cables by {s.tau:.3g} (standard deviation beyond "
                f"the uncertainty of each, nothing more allowed; Cochran's Q {s.q:.1f} of {s.dof}, "
                f"{_p_text(s.p_value)})"
            )
    if so_far:
        lines.append("interrupted before the gates; nothing was written")
    return lines


def _without_effect(result: LearningResult) -> str:
    """Meaning of a search without result."""
    if result.left_out:
        return "no effect that was tried explains more than chance; some were not tried"
    nothing = "no effect of the library explains more than chance"
    if negligible(result.baseline):
        nothing = (
            f"no effect was tried, because the error beyond the noise is below "
            f"{NEGLIGIBLE_M * 1e3:g} mm"
        )
    outcomes = learning_outcomes(result)
    reasons = " ".join(a.check.failed for a in outcomes if a.passed is False)
    verdict = learning_verdict(result, outcomes)
    if verdict == "complete":
        return (
            f"{nothing}: the model is complete for these cycles; smaller effects are possible "
            "(`cell diagnose` on a cycle's folder prints which sizes it excludes)"
        )
    if verdict == "unexplained":
        return f"{nothing}, and {reasons[0].lower()}{reasons[1:-1]}: {LAWS}"
    return f"{nothing}. {reasons}"


def _noise_name(result: LearningResult) -> str:
    """Where the noise is known from: the study, or the frames."""
    stated = {c.noise_model.stated for c in result.baseline.cables}
    if stated == {True}:
        return "stated noise"
    return "measured noise" if stated == {False} else "noise (of some cables stated)"


def learning_parts(
    result: LearningResult, gates: Sequence[CheckOutcome[LineEvidence]]
) -> list[str | TableData]:
    """Sentences and tables behind the result: verdict, checks, evidence per cycle, gates."""
    outcomes = learning_outcomes(result)
    verdict = learning_verdict(result, outcomes)
    parts: list[str | TableData] = [
        f"Verdict {verdict}: {LEARNING_VERDICTS[verdict]}.",
        checks_table([outcome.result for outcome in outcomes]),
    ]
    return parts if result.best is None else [*parts, cycle_table(result), gates_table(gates)]


def cycle_table(result: LearningResult) -> TableData:
    """Evidence of each cycle for or against the effect."""
    assert result.best is not None
    name = result.best.names[result.best.firsts[-1]].partition(".")[2]
    rows = []
    for v in result.cycle_evidence:
        direction = "for" if v.fall > 2.0 else "against" if v.fall < -2.0 else "neither"
        rows.append([v.cycle, direction, f"{v.fall:.1f}", f"{v.value:.4g}", f"{v.std:.2g}"])
    title = f"cycles for and against {result.best.effect.name}"
    return TableData(title, ["cycle", "speaks", "fall of χ²", name, "±"], rows, (2, 3, 4))


def gates_table(gates: Sequence[CheckOutcome[LineEvidence]]) -> TableData:
    """Table of a candidate's gates: limit and result of each."""
    limits = [row[2] for row in check_rows([g.result for g in gates])]
    rows = [
        [g.name, g.text, limit, "passed" if g.passed else "not passed"]
        for g, limit in zip(gates, limits, strict=True)
    ]
    colours = {"passed": "green", "not passed": "red"}
    return TableData("gates", ["", "found", "limit", ""], rows, colours=colours)


def _p_text(p_value: float) -> str:
    return f"p = {p_value:.2g}" if p_value > 1e-300 else "p < 1e-300"


def common_error_line(paired: Sequence[ForecastPair]) -> str:
    """Sentence on the mean error of all forecasts, with the present model and with the candidate.

    Empty if they are too few.
    """
    pairs = np.array([(f.present.above_m, f.candidate.above_m) for f in paired]).reshape(-1, 2)
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if len(pairs) < FEWEST:
        return ""
    texts = []
    for errors_m in pairs.T:
        mean_m, low_m, high_m = (1e3 * m for m in interval(errors_m, 0.95))
        texts.append(f"{mean_m:+z.3f} mm ({low_m:+z.3f} to {high_m:+z.3f})")
    return (
        f"in the mean of {len(pairs)} executions the tip passes the opening {texts[0]} above the "
        f"present model's forecast, {texts[1]} above the candidate's; 95 % intervals"
    )


#: Text for each outcome of the comparison with the earlier result.
_COMPARED = {
    "same": "the same values, bit for bit",
    "within": "every value within its 95 % interval of then",
    "outside": "a value outside its 95 % interval of then",
    "other model": "other parameters than then",
    "lost": "identified then, and not now",
    "nothing": "nothing was identified then",
}
_TEXT = 60


def identified_parts(result: IdentifiedAll, table: Path) -> list[str | TableData]:
    """Sentences and tables that `cell identify` prints for all recordings, in order."""
    counts = ", ".join(f"{count} {name}" for name, count in sorted(result.outcomes.items()))
    already = f" ({result.known} known from before)" if result.known else ""
    return [
        f"{result.done} of {counted(result.recordings, 'recording')}{already}: "
        f"{counts or 'none'}; in {table}",
        *([_compared(result)] if result.done else []),
        *([_moved(result)] if result.moved else []),
        *([_unidentified(result)] if result.unidentified else []),
    ]


def _compared(result: IdentifiedAll) -> TableData:
    rows = [
        [text, str(result.compared[name])]
        for name, text in _COMPARED.items()
        if result.compared[name]
    ]
    return TableData("Beside what was identified then", ["now", "recordings"], rows, (1,))


def _moved(result: IdentifiedAll) -> TableData:
    rows = [[row.recording, row.moved, f"{row.moved_std:.2f}"] for row in result.moved]
    heads = ["recording", "parameter", "moved by"]
    note = "in standard deviations of then; the table has all"
    return TableData("What has moved most", heads, rows, (2,), note)


def _unidentified(result: IdentifiedAll) -> TableData:
    rows = [
        [row.recording, row.outcome, row.why if len(row.why) <= _TEXT else f"{row.why[:_TEXT]} …"]
        for row in result.unidentified
    ]
    count = result.done - result.outcomes["identified"]
    note = f"{len(rows)} of {count}; the table has all" if count > len(rows) else ""
    return TableData("Not identified", ["recording", "outcome", "why"], rows, (), note)


_TEMPLATES = Path(__file__).parent / "templates"


def together_parts(result: Together) -> list[str | TableData]:
    """Sentences and tables of a joint diagnosis, in order."""
    rivals = ", ".join(" and ".join(names) for names in result.tied)
    tied = f"As much is explained by {rivals}: these studies cannot tell them apart."
    consistency = result.consistency
    return [
        f"Verdict {result.verdict}: {result.why}.",
        *([tied] if rivals else []),
        *(
            f"The cables differ in {c.parameter} by more than chance (p = {chance(c.q_p_value)})."
            for c in consistency
            if c.q_p_value < 0.01
        ),
        studies_table(result),
        *([consistency_table(consistency), values_table(consistency)] if consistency else []),
        hypotheses_table(result),
    ]


def studies_table(result: Together) -> TableData:
    """Table of the evidence of each study."""
    rows = [
        [
            part.study,
            part.alone,
            ", ".join(" or ".join(names) for names in part.missing) or "–",
            f"{part.delta_chi2:.1f}",
            "noise" if part.explained else "more than noise",
            part.says or "–",
        ]
        for part in result.studies
    ]
    heads = ["study", "verdict alone", "finds alone", "Δχ²", "what is left", "says"]
    effects = " and ".join(result.effects) or "no effect"
    note = f"Δχ², what is left and what it says: of {effects}"
    return TableData("The studies", heads, rows, (3,), note)


def consistency_table(consistency: Sequence[Consistency]) -> TableData:
    """Each parameter over all studies."""
    rows = [
        [
            c.parameter,
            f"{with_interval(c.value, c.low, c.high)} {c.unit}",
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
    """Table of each parameter's estimate from each study alone."""
    rows = [
        [values[0].study, *(with_interval(v.value, v.low, v.high) for v in values)]
        for values in zip(*(c.by_study for c in consistency), strict=True)
    ]
    heads = ["study", *(f"{c.parameter}, {c.unit}" for c in consistency)]
    return TableData("Parameters by study (95 %)", heads, rows)


def hypotheses_table(result: Together) -> TableData:
    """Table of the sets of effects that were fitted to all studies."""
    rows = [
        [" + ".join(h.effects) or "none", f"{h.evidence:.1f}", f"{h.delta_chi2:.1f}"]
        for h in result.hypotheses
    ]
    heads = ["effects", "ln evidence", "Δχ²"]
    note = "ln evidence: ln likelihood less BIC's penalty, sum over studies, beyond no effect"
    return TableData("Sets of effects, fitted to all studies", heads, rows, (1, 2), note)


def together_page(result: Together) -> str:
    """The result of a joint diagnosis as an HTML page."""
    return page(
        _TEMPLATES, "together.html", f"{len(result.studies)} studies", parts=together_parts(result)
    )
