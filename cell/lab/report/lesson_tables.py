"""The result of `cell learn` as sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from cell.lab.data.prepared import ERRS
from cell.lab.line.gates import Gate
from cell.lab.line.learn import LearningResult

#: What helps where the library has no name for what is missing.
LAWS = "`cell learn --laws` looks for a law that is not in the library"

FloatArray = NDArray[np.float64]


def lesson_lines(lesson: LearningResult, *, so_far: bool = False) -> list[str]:
    """What is missing, how much of the error it explains, and how sure that is.

    so_far  the search for effects was interrupted
    """
    before_m, noise_m = lesson.baseline.rms_m, lesson.noise_m
    first = (
        f"{_cables(len(lesson.cycles))}: the model misses {before_m * 1e3:.3f} mm rms, "
        f"the noise is {noise_m * 1e3:.3f} mm"
    )
    if lesson.best is None and so_far:
        return [first, "the missing effect is not identified yet; nothing was written"]
    if lesson.best is None:
        if lesson.left_out:
            tried = "no effect that was tried explains more than chance; some were not tried"
            return [first, tried]
        nothing = "no effect of the library explains more than chance"
        if before_m > ERRS * noise_m:
            return [first, f"{nothing}, and the model misses more than noise: {LAWS}"]
        return [first, f"{nothing}: the model is complete"]
    best, lines = lesson.best, [first]
    natural = best.fit.space.natural(_point(lesson))[best.fit.common]
    values = ", ".join(
        f"{name.partition('.')[2]} {value:.4g} {best.fit.space.units[i]}".removesuffix(" 1")
        for name, value, i in zip(best.names, natural, best.fit.common, strict=True)
    )
    lines.append(
        f"missing: {best.name} ({values}), {_chance(best.p_value)}; with it the model misses "
        f"{best.fit.rms_m * 1e3:.3f} mm"
    )
    if lesson.tied:
        lines.append(f"these cycles cannot distinguish it from: {', '.join(lesson.tied)}")
    for i, s in zip(best.firsts, lesson.spread, strict=True):
        if s.dof > 0:
            lines.append(
                f"{best.names[i]} differs between cables by {s.tau:.3g} (standard deviation; "
                f"Cochran's Q {s.q:.1f} of {s.dof}, {_chance(s.p_value)})"
            )
    if so_far:
        lines.append("interrupted before the gates; nothing was written")
    return lines


def _cables(count: int) -> str:
    return f"{count} cable" if count == 1 else f"{count} cables"


def votes_table(lesson: LearningResult) -> Table:
    """Which cycles speak for the effect, and which against."""
    assert lesson.best is not None
    name = lesson.best.names[lesson.best.firsts[-1]]
    table = Table(title=f"cycles for and against {lesson.best.effect.name}", box=SIMPLE_HEAD)
    for heading in ("cycle", "speaks", "fall of χ²", name.partition(".")[2], "±"):
        table.add_column(heading, justify="left" if heading in ("cycle", "speaks") else "right")
    for v in lesson.votes:
        speaks = "for" if v.fall > 2.0 else "against" if v.fall < -2.0 else "neither"
        table.add_row(v.cycle, speaks, f"{v.fall:.1f}", f"{v.value:.4g}", f"{v.std:.2g}")
    return table


def gates_table(judged: Sequence[Gate]) -> Table:
    """What a candidate must pass."""
    table = Table(title="gates", box=SIMPLE_HEAD)
    for heading in ("", "found", ""):
        table.add_column(heading)
    for g in judged:
        table.add_row(g.name, g.found, "[green]passed[/]" if g.passed else "[red]not passed[/]")
    return table


def _chance(p_value: float) -> str:
    return f"p = {p_value:.2g}" if p_value > 1e-300 else "p < 1e-300"


def _point(lesson: LearningResult) -> FloatArray:
    assert lesson.best is not None
    q = lesson.best.fit.space.mean.copy()
    q[lesson.best.fit.common] = lesson.best.fit.theta
    return q
