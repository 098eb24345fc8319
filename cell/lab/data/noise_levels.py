"""How noisy each marker of each trial is, where still frames show that they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf

from cell.cable.arrays import FloatArray
from cell.lab.data.noise_likelihood import DEGREE, NoiseBlock, RestFrames
from cell.lab.data.noise_model import Level, NoiseModel, noise_model_of_blocks, still_blocks
from cell.study.data import Study, Trial

#: Levels differ if chance makes them differ so much with this probability.  Few still frames with
#: outliers reach 1e-3 in 1 of 100 studies; markers of which some have twice the noise of others
#: reach 1e-13.
DIFFER = 1e-4
#: A marker at rest whose values are rounded to more than so many standard deviations shows the more
#: noise the nearer it is to a step: no level of its own.
ROUNDED = 1.0
#: Farther from the middle one than by this factor no level is believed: what repeats its values has
#: not been seen anew.
FARTHEST = 5.0


@dataclass(frozen=True, eq=False)
class Cells:
    """What still frames tell of the noise of each marker of each trial; all arrays by cell.

    trial, marker  whose it is
    root           mean of the roots of what is new in each frame, which outliers hardly move
    count          of values
    spread         variance of one value of mean 1
    source  Levene 1960; Brown & Forsythe 1974, J. Am. Stat. Assoc. 69, 364
    """

    trial: NDArray[np.intp]
    marker: NDArray[np.intp]
    root: FloatArray
    count: NDArray[np.int_]
    spread: float

    @property
    def log_level(self) -> FloatArray:
        """Ln of the mean square, but for a constant: a root goes with its fourth root."""
        return np.asarray(4.0 * np.log(self.root))

    @property
    def variance(self) -> FloatArray:
        """Of `log_level`."""
        return np.asarray(16.0 * self.spread / self.count)

    @property
    def p_value(self) -> float:
        """Of levels that differ so much by chance."""
        mean = float(np.average(self.root, weights=self.count))
        excess, dof = _heterogeneity(self.root / mean, self.spread / self.count)
        return float(chi2_sf(dof, excess)) if dof > 0 else 1.0


def with_levels(study: Study, noise_model: NoiseModel) -> NoiseModel:
    """The noise of a study, with the level of each marker of each trial, if they differ.

    As it was where the study states the noise, or where rounding changes what still frames show.
    """
    if noise_model.stated or noise_model.rest is None:
        return noise_model
    if noise_model.rest.resolution_m > ROUNDED * noise_model.noise.std_m:
        return noise_model
    markers = slice(0, len(study.arc_length_m))
    blocks = [still_blocks(t, markers) for t in study.trials]
    cells = cells_of(blocks, noise_model.rest, noise_model.noise.ar1)
    if cells is None or cells.p_value >= DIFFER:
        return noise_model
    levels, variance = shrunk(cells, len(study.trials), len(study.arc_length_m))
    levels = _normalised(study, levels)
    # of a mean square over the markers, each of which is so uncertain
    share = levels**2 / np.sum(levels**2, axis=1, keepdims=True)
    dof = 2.0 / np.sum(share**2 * variance, axis=1)
    level_blocks = [
        replace(b, z_m=b.z_m / level[np.asarray(b.series) // 2])
        for own, level in zip(blocks, levels, strict=True)
        for b in own
    ]
    series = [
        values
        for t in study.trials
        for values in t.markers.xy_m[:, markers].reshape(len(t.markers.t_s), -1).T
    ]
    found = noise_model_of_blocks(level_blocks, series, None, max(DEGREE, noise_model.rest.degree))
    assert found is not None  # there are blocks
    return replace(
        found,
        levels={
            t.name: Level(level, float(n))
            for t, level, n in zip(study.trials, levels, dof, strict=True)
        },
    )


def seen_in(noise_model: NoiseModel, told: NoiseModel, trials: Sequence[Trial]) -> NoiseModel:
    """The noise that frames of some trials tell, as that of these: another trial has its own.

    noise_model  before these frames were looked at
    """
    factor = told.noise.std_m / noise_model.noise.std_m
    names = {t.name for t in trials}
    levels = {
        name: Level(factor * level.of_markers, level.dof) if name in names else level
        for name, level in noise_model.levels.items()
    }
    noise = replace(told.noise, std_m=noise_model.noise.std_m)
    return replace(told, noise=noise, levels=levels)


def cells_of(blocks: Sequence[Sequence[NoiseBlock]], rest: RestFrames, ar1: float) -> Cells | None:
    """Of still blocks by trial; None if there are none."""
    roots: dict[tuple[int, int], list[FloatArray]] = {}
    for trial, own in enumerate(blocks):
        for block in own:
            left = 1.0 - (rest.degree + 1) / len(block.z_m)  # beside the polynomials
            white = np.sqrt(np.abs(rest.whitened(block, ar1)) / np.sqrt(left))
            for series, values in zip(block.series, white.T, strict=True):
                roots.setdefault((trial, series // 2), []).append(values)
    if not roots:
        return None
    each = [np.concatenate(values) for values in roots.values()]
    mean = np.array([float(v.mean()) for v in each])
    middle = float(np.median(mean))
    if middle == 0.0:
        return None
    mean = np.clip(mean, middle / np.sqrt(FARTHEST), middle * np.sqrt(FARTHEST))
    count = np.array([len(v) for v in each])
    of_one = sum(float(np.sum((v / m - 1.0) ** 2)) for v, m in zip(each, mean, strict=True))
    trials, markers = np.array(list(roots), dtype=np.intp).T
    return Cells(trials, markers, mean, count, of_one / max(int(count.sum()) - len(each), 1))


def shrunk(cells: Cells, trials: int, markers: int) -> tuple[FloatArray, FloatArray]:
    """(trials, markers) noise over that of all, as far as it is known, and how uncertain it is.

    returns  levels, and variances of the logarithms of their squares

    A marker has a level of its own, from which its trials differ.  Both are drawn to what is usual
    by as much as they are uncertain; a cell without still frames has its marker's level.
    source  Morris 1983, J. Am. Stat. Assoc. 78, 47: empirical Bayes
    """
    y, v, whose = cells.log_level, cells.variance, cells.marker
    usual = float(np.average(y, weights=1.0 / v))
    apart = [_heterogeneity(y[whose == m], v[whose == m]) for m in range(markers)]
    between = _between(
        sum(a[0] for a in apart),
        sum(a[1] for a in apart),
        sum(_information(1.0 / v[whose == m]) for m in range(markers)),
    )
    mean, spread = np.full(markers, usual), np.full(markers, np.inf)
    for m in np.unique(whose):
        weight = 1.0 / (v[whose == m] + between)
        mean[m], spread[m] = float(np.average(y[whose == m], weights=weight)), 1.0 / weight.sum()
    known = np.isfinite(spread)
    excess, dof = _heterogeneity(mean[known], spread[known])
    of_markers = _between(excess, dof, _information(1.0 / spread[known]))
    usual = float(np.average(mean[known], weights=1.0 / (spread[known] + of_markers)))
    kept = of_markers / (of_markers + spread[known]) if of_markers > 0.0 else 0.0 * spread[known]
    mean[known] = usual + (mean[known] - usual) * kept
    found = np.tile(mean, (trials, 1))
    variance = np.full((trials, markers), of_markers + between)
    variance[:, known] = between + spread[known]
    own = between / (between + v)
    found[cells.trial, whose] += (y - mean[whose]) * own
    variance[cells.trial, whose] = v * own + (1.0 - own) ** 2 * spread[whose]
    # what is divided by an uncertain mean square is too large on average, by half its variance
    return np.exp(0.5 * found + 0.25 * variance), variance


def _heterogeneity(y: FloatArray, variance: FloatArray) -> tuple[float, int]:
    """Cochran's Q of values, and its degrees of freedom."""
    if len(y) < 2:
        return 0.0, 0
    mean = float(np.average(y, weights=1.0 / variance))
    return float(np.sum((y - mean) ** 2 / variance)), len(y) - 1


def _information(weight: FloatArray) -> float:
    return float(weight.sum() - (weight @ weight) / weight.sum()) if len(weight) > 1 else 0.0


def _between(excess: float, dof: float, information: float) -> float:
    """Variance between values beyond what they are uncertain by (DerSimonian & Laird 1986)."""
    return max(excess - dof, 0.0) / information if information > 0.0 else 0.0


def _normalised(study: Study, levels: FloatArray) -> FloatArray:
    """Levels (trials, markers) of which the mean square over all that was seen is 1."""
    columns = len(study.arc_length_m)
    seen = [np.isfinite(t.markers.xy_m[:, :columns]).sum(axis=(0, 2)) for t in study.trials]
    return np.asarray(levels / np.sqrt(np.average(levels**2, weights=np.array(seen))))


def rms_level(levels: Mapping[str, Level], seen: Mapping[str, NDArray[np.int_]]) -> float:
    """Noise of some trials over that of all.

    seen  by trial (markers,) number of values
    """
    if not levels or not any(s.any() for s in seen.values()):
        return 1.0
    square = sum(float(levels[name].of_markers ** 2 @ s) for name, s in seen.items())
    return float(np.sqrt(square / sum(int(s.sum()) for s in seen.values())))
