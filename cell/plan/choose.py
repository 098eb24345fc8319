"""The choice of an offset: each is simulated as it will be executed, with its uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import ndtr
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.branches import simulate_branches
from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.identify.parameters import difference_points
from cell.plan.destination import Destination
from cell.settings.model import REPEATABILITY_M

#: Factors on the step and on the number of segments for the sensitivities of a tip, whose error is
#: then 1 %.
SLOPES_COARSER, SLOPES_SEGMENTS = 4.0, 0.7
#: Sampling interval of simulated tips and nodes, s.
INTERVAL_S = 0.005
#: Standard deviation of the tip's height due to the model's error, per `Identified.model_error_m`:
#: the error is larger in a new motion than in the fitted one.
MODEL_ERROR_GROWTH = 2.0


@dataclass(frozen=True)
class Freedom:
    """Degrees of freedom of an insertion in addition to the offset: delay, pace and reach.

    window_s   largest delay of an insertion; 0 = none
    paces      factors on the usual duration
    further_m  extra reach to the left
    """

    window_s: float = 0.0
    paces: tuple[float, ...] = ()
    further_m: float = 0.0


@dataclass(frozen=True)
class ChoiceOptions:
    """Options of the choice of an offset.

    samples           of the uncertain parameters; at least twice their number
    repeatability_m   standard deviation of the tip's height for reasons that are not the cable's:
                      arm, camera, draught

    least_probability below which no offset is chosen

    freely            degrees of freedom in addition to the offsets
    """

    samples: int = 64
    repeatability_m: float = REPEATABILITY_M

    least_probability: float = 0.9

    freely: Freedom = Freedom()


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predicted tip paths of all offsets, with their sensitivities.

    offsets_m    (O,) m
    delays_s     (O,) delay of its path after the first, s
    paces        (O,) factors on the usual duration of the strokes
    further_m    (O,) extra reach to the left, m
    t_s          (T,) s, from when the path begins
    mean         (p,) fit coordinates simulated
    tip_m        (O, T, 2) with them, m
    sensitivity  (O, T, 2, p) derivatives of it by the fit coordinates
    """

    offsets_m: FloatArray
    delays_s: FloatArray
    paces: FloatArray
    further_m: FloatArray
    t_s: FloatArray
    mean: FloatArray
    tip_m: FloatArray
    sensitivity: FloatArray

    def moved_to(self, mean: FloatArray) -> Forecast:
        """Forecast for slightly different coordinates (p,), to first order, without simulating.

        It updates a forecast with the last frames of a hold, which change little: see `choose`.
        """
        tip_m = self.tip_m + self.sensitivity @ (mean - self.mean)
        return replace(self, mean=mean, tip_m=tip_m)

    def joined_with(self, more: Forecast) -> Forecast:
        """These offsets and more, of the same cable at the same times."""
        joined = {
            name: np.concatenate([getattr(self, name), getattr(more, name)])
            for name in ("offsets_m", "delays_s", "paces", "further_m", "tip_m", "sensitivity")
        }
        return replace(self, **joined)


@dataclass(frozen=True)
class OffsetForecast:
    """Forecast of one offset: probability of passing, margin (see `Destination`), m; delay, s;
    pace; extra reach of the gripper, m (see `Forecast`)."""

    offset_m: float
    probability: float
    margin_m: float
    margin_std_m: float
    delay_s: float = 0.0
    pace: float = 1.0
    further_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Choice:
    """The offset chosen, or why none is.

    best      most promising offset, chosen or not
    table     all offsets
    reason    None if `best` is chosen, else why it is not
    model_misses   whether none is, and the model's error exceeds the repeatability
    t_s, tip_m   (T,), (T, 2) predicted tip path of `best`
    """

    best: OffsetForecast
    table: tuple[OffsetForecast, ...]
    reason: str | None
    t_s: FloatArray
    tip_m: FloatArray
    model_misses: bool = False

    @property
    def chosen(self) -> bool:
        """Whether `best` may be executed."""
        return self.reason is None


def forecast(
    identified: Identified,
    offsets_m: FloatArray,
    motions: Sequence[Motion],
    *,
    begin_s: float = 0.0,
    end_s: float | None = None,
    solver: Solver = Solver(),  # noqa: B008
) -> Forecast:
    """Simulate every offset, without delay at the usual pace, and the tip's sensitivities.

    motions  of the gripper, one per offset, the same until the path begins (see `executed_motion`):
             the common part is simulated once.  They are on the clock of the identification,
             because an effect may depend on the time.
    begin_s  start of the path on that clock
    end_s    end of the simulation; None = end of the last motion
    raises   ValueError: not one motion per offset; as the engine
    """
    if len(motions) != len(offsets_m):
        raise ValueError(f"{len(offsets_m)} offsets but {len(motions)} motions")
    end_s = max(float(m.t_s[-1]) for m in motions) if end_s is None else end_s
    t_s = np.arange(0.0, end_s - begin_s + INTERVAL_S, INTERVAL_S)
    at_s = begin_s + t_s
    space, mean = identified.space, identified.mean
    tip_at_m = np.array([space.cable.length_m])
    lanes = difference_points(mean, space.difference_steps(mean, identified.covariance))
    models = [space.model(q) for q in lanes]
    tip_m = simulate_branches(models[:1], motions, begin_s, at_s, tip_at_m, solver=solver)
    tip_m = tip_m[:, 0, :, 0]
    coarser = coarsened(solver)
    nearby_m = simulate_branches(models, motions, begin_s, at_s, tip_at_m, solver=coarser)
    nearby_m = nearby_m[:, :, :, 0]
    step = np.diag(lanes[1:] - mean)
    slopes = (nearby_m[:, 1:] - nearby_m[:, :1]) / step[:, None, None]
    none, usual = np.zeros(len(offsets_m)), np.ones(len(offsets_m))
    return Forecast(offsets_m, none, usual, none, t_s, mean, tip_m, np.moveaxis(slopes, 1, -1))


def coarsened(solver: Solver) -> Solver:
    """A coarser solver, for sensitivities of the tip and for a first search."""
    segments = max(4, round(SLOPES_SEGMENTS * solver.segments))
    return replace(solver, segments=segments, step_s=SLOPES_COARSER * solver.step_s)


def choose(
    expected: Forecast,
    identified: Identified,
    destination: Destination,
    options: ChoiceOptions = ChoiceOptions(),
) -> Choice:
    """The offset most likely to pass; among equally likely ones the earliest, then the fastest,
    then the one with the widest margin.

    expected  forecast of `identified` or of nearly the same cable, made during the hold
    """
    expected = expected.moved_to(identified.mean)
    drawn = deviates(len(identified.mean) + 1, options.samples)
    shift = drawn[:, :-1] @ identified.root.T
    raised_m = missed_height_m(identified, options) * drawn[:, -1]
    margins = np.array([destination.margin_m(tips) for tips in _tips(expected, shift, raised_m)])
    probable = destination.margin_m(expected.tip_m)
    table = tuple(
        OffsetForecast(
            offset_m=float(offset),
            probability=float(probability),
            margin_m=float(margin),
            margin_std_m=float(std),
            delay_s=float(delay),
            pace=float(pace),
            further_m=float(further_m),
        )
        for offset, delay, pace, further_m, probability, margin, std in zip(
            expected.offsets_m,
            expected.delays_s,
            expected.paces,
            expected.further_m,
            np.mean(margins > 0.0, axis=1),
            probable,
            np.std(margins, axis=1),
            strict=True,
        )
    )
    index = max(
        range(len(table)),
        key=lambda i: (table[i].probability, -table[i].delay_s, -table[i].pace, table[i].margin_m),
    )
    best = table[index]
    reason, model_misses = None, False
    if best.probability < options.least_probability:
        reason = (
            f"no offset passes with probability ≥ {options.least_probability:.2f}: the best, "
            f"{best.offset_m * 1e3:.0f} mm, with {best.probability:.2f} "
            f"(margin {best.margin_m * 1e3:+z.2f} mm)"
        )
        missed_m = MODEL_ERROR_GROWTH * identified.model_error_m
        model_misses = missed_m > options.repeatability_m
        if model_misses:
            missed_mm = identified.model_error_m * 1e3
            reason += f"; the model misses this cable's tip by {missed_mm:.2f} mm while it swings"
    return Choice(best, table, reason, expected.t_s, expected.tip_m[index], model_misses)


def missed_height_m(identified: Identified, options: ChoiceOptions) -> float:
    """Standard deviation of the tip's height from causes other than the cable's parameters, m."""
    missed_m = MODEL_ERROR_GROWTH * identified.model_error_m
    return float(np.hypot(missed_m, options.repeatability_m))


def _tips(expected: Forecast, shift: FloatArray, raised_m: FloatArray) -> Iterator[FloatArray]:
    """Per offset (samples, T, 2) tip paths for shifts (samples, p) of the coordinates, m.

    Fast, as the gripper waits for it: tip and random rise (samples,) are two more columns of one
    matrix product, and offsets are computed one by one to fit into the cache.
    """
    weights = np.column_stack([shift, np.ones(len(shift)), raised_m])
    for tip_m, sensitivity in zip(expected.tip_m, expected.sensitivity, strict=True):
        slopes = np.empty((weights.shape[1], *tip_m.shape))
        slopes[:-2] = np.moveaxis(sensitivity, -1, 0)
        slopes[-2], slopes[-1] = tip_m, [0.0, 1.0]
        tips = weights @ slopes.reshape(len(slopes), -1)
        yield np.asarray(tips.reshape(-1, *tip_m.shape), dtype=np.float64)


@lru_cache(maxsize=8)
def deviates(dimensions: int, samples: int) -> FloatArray:
    """(samples, dimensions) standard normal deviates, one in every stratum, reproducible.

    They are scaled to unit covariance, which needs more samples than dimensions: `samples` is
    raised to twice the dimensions if it is less.

    source  McKay, Beckman & Conover 1979 (Latin hypercubes)
    """
    samples = max(samples, 2 * dimensions)
    strata = normal_quantile((np.arange(samples) + 0.5) / samples)
    rng = np.random.default_rng(20260101)
    drawn = rng.permuted(np.tile(strata, (dimensions, 1)), axis=1)
    root = np.linalg.cholesky(drawn @ drawn.T / samples)
    return np.asarray(np.linalg.solve(root, drawn).T)


#: Least expected change of the probability for which further frames are waited for.
SMALL_CHANGE = 0.01


def enough_frames(
    choice: Choice,
    expected: Forecast,
    identified: Identified,
    destination: Destination,
    options: ChoiceOptions = ChoiceOptions(),
) -> bool:
    """Whether an offset is chosen whose probability further frames would hardly change.

    False for a cable that would be rejected: all frames are then used.

    choice  of `expected`, forecast of `identified`
    """
    if not choice.chosen:
        return False
    return expected_change(choice, expected, identified, destination, options) < SMALL_CHANGE


def expected_change(
    choice: Choice,
    expected: Forecast,
    identified: Identified,
    destination: Destination,
    options: ChoiceOptions = ChoiceOptions(),
) -> float:
    """Expected change of the best offset's probability if the cable's parameters were known.

    Given the parameters, only the other causes remain uncertain: model error, arm, camera and
    cross-flow, which more frames do not reduce.  Only the nearer edge of the opening counts.
    """
    index = choice.table.index(choice.best)
    shift = deviates(len(identified.mean) + 1, options.samples)[:, :-1] @ identified.root.T
    tips_m = expected.moved_to(identified.mean).tip_m[index] + np.moveaxis(
        expected.sensitivity[index] @ shift.T, -1, 0
    )
    known = ndtr(destination.margin_m(tips_m) / missed_height_m(identified, options))
    return float(np.abs(known - known.mean()).mean())
