"""The result of `cell learn` as sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.table import TableData
from cell.files.words import counted
from cell.lab.data.check import CheckOutcome
from cell.lab.data.results import Verdict
from cell.lab.line.forecasts import ForecastPair
from cell.lab.line.learn import LearningResult
from cell.lab.line.learning_checks import learning_outcomes, learning_verdict
from cell.lab.line.learning_questions import LineEvidence
from cell.lab.report.tables import checks_table
from cell.lab.report.wording import check_rows
from cell.records.mean_error import FEWEST, interval

#: What helps where the library has no name for what is missing.
LAWS = "`cell learn --laws` looks for a law that is not in the library"

#: What the verdict of `cell learn` means.
LEARNING_VERDICTS: dict[Verdict, str] = {
    "complete": "these cycles show no missing effect",
    "missing": "the effect named is missing in the model; the gates say whether it helps the line",
    "unexplained": "the model lacks an effect, and none that was tried explains the error",
    "cannot_tell": "these cycles cannot decide whether the model lacks an effect, or which one",
}


def learning_lines(result: LearningResult, *, so_far: bool = False) -> list[str]:
    """What is missing, how much of the error it explains, and how sure that is.

    so_far  the search for effects was interrupted
    """
    before_m, noise_m = result.baseline.rms_m, result.noise_m
    first = (
        f"{_cables(len(result.cycles))}: the model misses {before_m * 1e3:.3f} mm rms, "
        f"the noise is {noise_m * 1e3:.3f} mm"
    )
    if result.best is None and so_far:
        return [first, "the missing effect is not identified yet; nothing was written"]
    if result.best is None:
        return [first, _nothing(result)]
    best, lines = result.best, [first]
    natural = best.fit.space.natural(_point(result))[best.fit.common]
    values = ", ".join(
        f"{name.partition('.')[2]} {value:.4g} {best.fit.space.units[i]}".removesuffix(" 1")
        for name, value, i in zip(best.names, natural, best.fit.common, strict=True)
    )
    lines.append(
        f"missing: {best.name} ({values}), {_chance(best.p_value)}; with it the model misses "
        f"{best.fit.rms_m * 1e3:.3f} mm"
    )
    if result.tied:
        lines.append(f"these cycles cannot distinguish it from: {', '.join(result.tied)}")
    for i, s in zip(best.firsts, result.spread, strict=True):
        if s.dof > 0:
            lines.append(
                f"{best.names[i]} differs between cables by {s.tau:.3g} (standard deviation; "
                f"Cochran's Q {s.q:.1f} of {s.dof}, {_chance(s.p_value)})"
            )
    if so_far:
        lines.append("interrupted before the gates; nothing was written")
    return lines


def _nothing(result: LearningResult) -> str:
    """What it means that no effect was found."""
    if result.left_out:
        return "no effect that was tried explains more than chance; some were not tried"
    nothing = "no effect of the library explains more than chance"
    found = learning_outcomes(result)
    why = " ".join(a.check.failed for a in found if a.passed is False)
    verdict = learning_verdict(result, found)
    if verdict == "complete":
        return f"{nothing}: the model is complete"
    if verdict == "unexplained":
        return f"{nothing}, and {why[0].lower()}{why[1:-1]}: {LAWS}"
    return f"{nothing}. {why}"


def learning_parts(
    result: LearningResult, judged: Sequence[CheckOutcome[LineEvidence]]
) -> list[str | TableData]:
    """What the result rests on: the verdict, its checks, the evidence of each cycle, the gates."""
    found = learning_outcomes(result)
    verdict = learning_verdict(result, found)
    parts: list[str | TableData] = [
        f"Verdict {verdict}: {LEARNING_VERDICTS[verdict]}.",
        checks_table([answer.result for answer in found]),
    ]
    return parts if result.best is None else [*parts, cycle_table(result), gates_table(judged)]


def _cables(count: int) -> str:
    return counted(count, "cable")


def cycle_table(result: LearningResult) -> TableData:
    """Which cycles speak for the effect, and which against."""
    assert result.best is not None
    name = result.best.names[result.best.firsts[-1]].partition(".")[2]
    rows = []
    for v in result.cycle_evidence:
        speaks = "for" if v.fall > 2.0 else "against" if v.fall < -2.0 else "neither"
        rows.append([v.cycle, speaks, f"{v.fall:.1f}", f"{v.value:.4g}", f"{v.std:.2g}"])
    title = f"cycles for and against {result.best.effect.name}"
    return TableData(title, ["cycle", "speaks", "fall of χ²", name, "±"], rows, (2, 3, 4))


def gates_table(judged: Sequence[CheckOutcome[LineEvidence]]) -> TableData:
    """What a candidate must pass."""
    limits = [row[2] for row in check_rows([g.result for g in judged])]
    rows = [
        [g.name, g.found, limit, "passed" if g.passed else "not passed"]
        for g, limit in zip(judged, limits, strict=True)
    ]
    colours = {"passed": "green", "not passed": "red"}
    return TableData("gates", ["", "found", "limit", ""], rows, colours=colours)


def _chance(p_value: float) -> str:
    return f"p = {p_value:.2g}" if p_value > 1e-300 else "p < 1e-300"


def _point(result: LearningResult) -> FloatArray:
    assert result.best is not None
    q = result.best.fit.space.mean.copy()
    q[result.best.fit.common] = result.best.fit.theta
    return q


def common_error_line(paired: Sequence[ForecastPair]) -> str:
    """What the forecasts of all executions have in common, at present and with the candidate.

    Empty if they are too few to tell.
    """
    pairs = np.array([(f.present_above_m, f.candidate_above_m) for f in paired]).reshape(-1, 2)
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if len(pairs) < FEWEST:
        return ""
    said = []
    for errors_m in pairs.T:
        mean_m, low_m, high_m = (1e3 * m for m in interval(errors_m, 0.95))
        said.append(f"{mean_m:+z.3f} mm ({low_m:+z.3f} to {high_m:+z.3f})")
    return (
        f"in the mean of {len(pairs)} executions the tip passes the mouth {said[0]} above the "
        f"present model's forecast, {said[1]} above the candidate's; 95 % intervals"
    )
