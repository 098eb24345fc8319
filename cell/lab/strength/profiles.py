"""Profile-likelihood intervals of a fitted model, as data and for its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.files.plain import plain
from cell.identify.gauss_newton import Options, minimise
from cell.identify.identified import Identified
from cell.identify.profile import profile
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.work import Progress, no_progress
from cell.lab.fit.fitting import Fit, fit_trials, problem_of

#: Each point is a separate fit, started from the previous one.
_POINT = Options(tolerance=0.1, max_iterations=12, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class ParameterProfile:
    """The profile of one parameter in natural values.

    fitted             the fit's value
    value, low, high   the likeliest, and the ends of the 95 % interval; infinite if open
    wald               low and high by the curvature at the minimum
    values, rise       (points,) held values, and the rise of -2 ln likelihood there
    at_bound           (points,) names of other parameters at a bound there
    better             a lower minimum was met on the way
    """

    name: str
    unit: str
    logarithmic: bool
    fitted: float
    value: float
    low: float
    high: float
    wald: tuple[float, float]
    values: FloatArray
    rise: FloatArray
    at_bound: tuple[tuple[str, ...], ...]
    better: bool

    def to_json(self) -> dict[str, Any]:
        """Plain data; null where an interval has no end."""
        content = {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "low": self.low,
            "high": self.high,
            "better": self.better,
            "points": [
                {"value": float(v), "rise": float(r), "at_bound": list(names)}
                for v, r, names in zip(self.values, self.rise, self.at_bound, strict=True)
            ],
        }
        return dict(plain(content))


def each_profile(
    prepared: PreparedStudy, fit: Fit, model: Identified, progress: Progress = no_progress
) -> Iterator[ParameterProfile]:
    """Yield the profile of each free parameter, all others refitted at every point.

    The residual's excess over noise counts as in the model's other intervals: all but the prior is
    divided by the root of the inflation, so that the likeliest value is nearer to the prior.  The
    bias by omitted effects is included in those intervals only, not in a profile.
    model  of the fit, with the noise used there
    """
    space = fit.space
    prepared = PreparedStudy.of(
        prepared.unjoined, misfit=model.noise, solver=prepared.solver, work=prepared.work
    )
    problem = problem_of(
        prepared, space, fit_trials(prepared), residual_scale=float(np.sqrt(model.inflation))
    )
    minimum = minimise(problem, fit.solution.q, _POINT)
    free = [i for i in range(len(space.names)) if problem.low[i] < problem.high[i]]
    reach = float(normal_quantile(0.975)) * np.sqrt(np.diag(minimum.covariance))
    low, high = (
        space.natural(np.clip((minimum.q + side * reach)[: len(fit.q)], space.low, space.high))
        for side in (-1.0, 1.0)
    )

    def natural(q: float, i: int) -> float:
        return float(np.exp(q)) if space.logarithmic[i] else q

    # those of initial states have no name
    names = [*space.names, *["how a trial begins"] * (len(fit.solution.q) - len(space.names))]
    for done, i in enumerate(free):
        progress(f"profile of {space.names[i]}", done, len(free))
        of = profile(problem, minimum, i, _POINT)
        yield ParameterProfile(
            name=space.names[i],
            unit=space.units[i],
            logarithmic=bool(space.logarithmic[i]),
            fitted=natural(float(fit.q[i]), i),
            value=natural(float(minimum.q[i]), i),
            low=natural(of.low, i) if np.isfinite(of.low) else -np.inf,
            high=natural(of.high, i),
            wald=(float(low[i]), float(high[i])),
            values=np.array([natural(p.q, i) for p in of.points]),
            rise=np.array([p.rise for p in of.points]),
            at_bound=tuple(tuple(names[k] for k in p.at_bound) for p in of.points),
            better=of.better,
        )


def profile_sentences(profiles: Sequence[ParameterProfile]) -> list[str]:
    """Remarks on the profiles: open intervals, parameters at bounds, a better minimum."""
    notes = []
    for p in profiles:
        if p.better:
            notes.append(f"{p.name}: the profile found a better fit than the one it started from")
        if not (np.isfinite(p.low) and np.isfinite(p.high)):
            sides = [w for w, v in (("low", p.low), ("high", p.high)) if not np.isfinite(v)]
            notes.append(f"{p.name} is not bounded by this study: no {' or '.join(sides)} value is "
                         "excluded")  # fmt: skip
        bounded = sorted({n for names in p.at_bound for n in names})
        if bounded:
            notes.append(f"{p.name}: its interval depends on the bound of {', '.join(bounded)}")
    return notes
