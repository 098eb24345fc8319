"""Test of the smooth part of a residual against noise; model errors are smooth, noise is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import chdtri as chi2_quantile
from scipy.special import fdtrc as f_sf
from scipy.special import fdtri as f_quantile

from cell.cable.arrays import FloatArray
from cell.identify.gaussian import marginal_chi2, marginal_products
from cell.identify.whitener import Whitener
from cell.lab.data.noise_likelihood import MAX_AR1
from cell.lab.data.noise_model import NoiseModel
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.all_trials_fit import AllTrialsFit, of_all_trials
from cell.lab.fit.corrections import LEFT
from cell.lab.fit.fitting import Fit, best_initial_state, fit_trials
from cell.lab.fit.heldout import HeldoutRows, heldout_rows
from cell.lab.fit.projection import jacobian_with_prior
from cell.lab.fit.systematic_error import MOTIONS, SystematicError, systematic_error


@dataclass(frozen=True)
class ExpectedSquare:
    """Expected value of a sum of squares under noise alone, and its degrees of freedom.

    mean       of the sum
    dof        of the χ² that has, scaled, the same mean and variance: the number of values if all
               are independent and equal, fewer if errors common to many of them are larger
    dof_mean   degrees of freedom behind the mean
    source     Satterthwaite 1946, Biometrics Bulletin 2, 110
    """

    mean: float
    dof: float
    dof_mean: float

    @staticmethod
    def of(
        noise: FloatArray, level: float, dof_level: float, errors: FloatArray, draws: int
    ) -> ExpectedSquare:
        """Of values that noise and some errors shift.

        noise      (n, n) covariance by noise of level 1
        level      mean square of the noise, known by so many degrees of freedom
        errors     (n, k) changes by errors: each column a standard deviation in its direction
        draws      number of draws that the errors' covariance is known by
        """
        shared = 2.0 * level * float(np.sum((noise @ errors) * errors))
        square = level**2 * float(np.sum(noise**2)) + shared
        of_noise = level * float(np.trace(noise))
        return _of_traces(of_noise, dof_level, square, errors.T @ errors, draws)

    @staticmethod
    def of_white(
        count: float, level: float, dof_level: float, products: FloatArray, draws: int
    ) -> ExpectedSquare:
        """The same of so many independent values; (k, k) products of the errors' changes."""
        square = level**2 * count + 2.0 * level * float(np.trace(products))
        return _of_traces(level * count, dof_level, square, products, draws)

    def exceeded_with(self, p: float) -> float:
        """The sum of squares that is exceeded with this probability."""
        if np.isfinite(self.dof_mean):
            return self.mean * float(f_quantile(self.dof, self.dof_mean, 1.0 - p))
        return self.mean * float(chi2_quantile(self.dof, p)) / self.dof


def _of_traces(
    of_noise: float, dof_level: float, square: float, products: FloatArray, draws: int
) -> ExpectedSquare:
    """By what noise adds to tr C, and noise and its products with the errors to tr C²."""
    of_errors = float(np.sum(products**2))
    mean = of_noise + float(np.trace(products))
    uncertain = of_noise**2 / dof_level + of_errors / draws
    return ExpectedSquare(
        mean,
        mean**2 / max(square + of_errors, 1e-300),
        mean**2 / uncertain if uncertain > 0.0 else np.inf,
    )


@dataclass(frozen=True)
class SmoothPart:
    """χ² of the smooth part of a residual, allowing for what the fit leaves uncertain.

    chi2     about `count` if the model is right; inf where the cable cannot be simulated
    rows     values of the whole residual
    dof      degrees of freedom behind what a right model leaves there
    effective_dof  degrees of freedom of `chi2`, of the scaled χ² that varies as much; None =
             `count`, as where noise alone shifts the values
    """

    chi2: float
    count: float
    rows: int
    dof: float
    effective_dof: float | None = None

    @property
    def excess(self) -> float:
        """What is beyond noise, per value; below 0 by chance."""
        return self.chi2 / self.count - 1.0

    @property
    def excess_of_all(self) -> float:
        """The same as a mean square over the whole residual, in units of the noise's."""
        return (self.chi2 - self.count) / self.rows

    @property
    def p_value(self) -> float:
        """Of noise alone."""
        return self.chance_of(self.excess)

    def chance_of(self, excess: float) -> float:
        """p-value that so much beyond noise would have."""
        own = self.count if self.effective_dof is None else self.effective_dof
        if not np.isfinite(self.dof):
            return float(chi2_sf(own, own * (1.0 + excess)))
        return float(f_sf(own, self.dof, 1.0 + excess))


@once_per_study
def smooth_part(prepared: PreparedStudy, fit: Fit) -> SmoothPart | None:
    """The smooth part of the held-out residual; None if it cannot be tested.

    It cannot be tested without held-out trials, nor if the noise is an earlier model's misfit or a
    level that the study states, because such errors may be smooth themselves.
    """
    if not noise_was_seen(prepared) or not prepared.study.role("validate"):
        return None
    rows = heldout_rows(prepared, fit)
    if not (np.all(np.isfinite(rows.residual)) and np.all(np.isfinite(rows.spread))):
        return SmoothPart(np.inf, 1, len(rows.residual), prepared.noise_model.slow_dof)
    coarse = _coarse(prepared, rows.residual[None])
    level, dof = _heldout_level(prepared, rows)
    chi2 = marginal_chi2(coarse[0], _coarse(prepared, rows.spread.T).T)[0] / level
    return SmoothPart(chi2, coarse.shape[1], len(rows.residual), dof)


def noise_was_seen(prepared: PreparedStudy) -> bool:
    """Whether the level of noise is that of still frames: not stated, nor a model's error."""
    return prepared.noise_is_measured and not prepared.noise_model.stated


@once_per_study
def of_a_finer_model(prepared: PreparedStudy, fit: Fit) -> SmoothPart | None:
    """As `smooth_part`, without mesh error and gripper-log error.

    To first order: the parameters follow what mesh and log change in the trials that they were
    fitted to, and what stays of it is seen in those held out.
    """
    seen = smooth_part(prepared, fit)
    if seen is None or not np.isfinite(seen.chi2):
        return seen
    rows, held = heldout_rows(prepared, fit), prepared.study.role("validate")
    initial_states = {
        **fit.initial_states,
        **{t.name: best_initial_state(prepared, fit.model, t) for t in held},
    }
    there = systematic_error(prepared, replace(fit, initial_states=initial_states), held)
    fitted = systematic_error(prepared, fit, fit_trials(prepared))
    mesh = there.mesh + _followed(fit, fitted.mesh[None])[0] @ rows.by_parameters.T
    doubt = there.doubt + _followed(fit, fitted.doubt[None])[0] @ rows.by_parameters.T
    changes = [LEFT * doubt[None], *_each_alone(there)]
    changes += [_followed(fit, alone) @ rows.by_parameters.T for alone in _each_alone(fitted)]
    residual = (rows.residual + (1.0 + LEFT) * mesh)[None]
    coarse = _coarse(prepared, np.concatenate([residual, *changes]))
    products = marginal_products(coarse, _coarse(prepared, rows.spread.T).T)
    level = _heldout_level(prepared, rows)
    expected = ExpectedSquare.of_white(seen.count, *level, products[1:, 1:], MOTIONS)
    chi2 = float(products[0, 0]) * seen.count / expected.mean
    return replace(seen, chi2=chi2, dof=expected.dof_mean, effective_dof=expected.dof)


def _each_alone(errors: SystematicError) -> list[FloatArray]:
    """(motions, rows) by a gripper log that is wrong in one trial, of each of the trials."""
    found = []
    for part in np.split(np.arange(errors.gripper_motions.shape[1]), errors.ends[:-1]):
        alone = np.zeros_like(errors.gripper_motions)
        alone[:, part] = errors.gripper_motions[:, part] / np.sqrt(MOTIONS)
        found.append(alone)
    return found


@dataclass(frozen=True, eq=False)
class AllTrialsResidual:
    """The residual of a model fitted to all trials, and its systematic error.

    every     (1 + errors + basis, rows) residual, less the mesh's error, and without what the
              parameters imitate; what mesh and hands may still change it by; the parameters' basis.
              The prior's rows come last
    """

    whole: AllTrialsFit
    whiteners: list[Whitener]
    every: FloatArray
    errors: int

    @cached_property
    def by_trial(self) -> list[tuple[Whitener, FloatArray]]:
        """`every` of each trial, (…, rows of the trial)."""
        return list(
            zip(self.whiteners, self.whole.systematic_error.by_trial(self.every), strict=True)
        )

    @cached_property
    def level(self) -> tuple[float, float]:
        """Of slow noise, and the degrees of freedom behind it; as stated, if it is."""
        noise_model = self.whole.prepared.noise_model
        if not noise_was_seen(self.whole.prepared):
            return 1.0, np.inf
        fast = [FastPart.of(w, p[0]) for w, p in self.by_trial]
        return _slow_level(noise_model, fast, noise_model.slow_dof)

    def part(self, coordinates: Callable[[Whitener, FloatArray], FloatArray]) -> SmoothPart:
        """χ² in orthonormal directions of each trial: (directions, n) coordinates of (rows, n)."""
        return self.judged(np.concatenate([coordinates(w, p.T) for w, p in self.by_trial]))

    def half_shows_from(self, noise: FloatArray, directions: FloatArray, p: float) -> float:
        """χ² in some directions (n, rows) of which half would have this p-value.

        noise  (n, n) their covariance by noise, without what the parameters imitate
        """
        rows = self.whole.systematic_error.ends[-1]
        errors = directions @ self.every[1 : 1 + self.errors, :rows].T
        expected = ExpectedSquare.of(noise, 1.0, self.level[1], errors, MOTIONS)
        return 2.0 * expected.exceeded_with(p) - expected.mean

    def judged(self, coarse: FloatArray) -> SmoothPart:
        """χ² by (directions, 1 + errors + basis) coordinates of `every` in orthonormal ones."""
        left, errors, basis = np.split(coarse, [1, 1 + self.errors], axis=1)
        noise = np.eye(len(coarse)) - basis @ basis.T
        expected = ExpectedSquare.of(noise, *self.level, errors, MOTIONS)
        count = float(np.trace(noise))
        chi2 = float(np.sum(left**2)) * count / expected.mean
        rows = sum(w.count for w in self.whiteners)
        return SmoothPart(chi2, count, rows, expected.dof_mean, expected.dof)


@once_per_study
def all_trials_residual(prepared: PreparedStudy, fit: Fit) -> AllTrialsResidual | None:
    """The residual of the model refitted to all trials; None if one cannot be simulated."""
    whole = of_all_trials(prepared, fit)
    if whole is None:
        return None
    linear, errs, trials = whole.linear, whole.systematic_error, fit_trials(whole.prepared)
    changes = np.concatenate([errs.doubt[None] * LEFT, *_each_alone(errs)])
    behind = len(linear.residual) - errs.ends[-1]  # the prior's rows
    errors = linear.remove(np.pad(changes, ((0, 0), (0, behind))))
    every = np.vstack([linear.residual, errors, linear.basis.T])
    whiteners = [whole.prepared.whiteners[t.name] for t in trials]
    return AllTrialsResidual(whole, whiteners, every, len(errors))


@dataclass(frozen=True)
class FastPart:
    """White residuals of a trial without their smooth part: sums over frames and channels.

    square, products    of values, and of each with the one of the frame before
    values, neighbours  what these sums are of white noise of unit size
    """

    square: float
    products: float
    values: float
    neighbours: float
    pairs: int

    @staticmethod
    def of(whitener: Whitener, white: FloatArray) -> FastPart:
        """Of (rows,)."""
        grid = white.reshape(-1, whitener.channels, whitener.frames)
        square = products = values = neighbours = 0.0
        pairs = 0
        for channel in range(whitener.channels):
            modes = whitener.smooth_modes[channel]
            series = grid[:, channel]
            fast = series - (modes @ (modes.T @ series.ravel())).reshape(series.shape)
            seen = whitener.seen[..., channel].T
            fast = np.where(seen, fast, 0.0)
            shaped = modes.reshape(*series.shape, -1)
            square += float(np.sum(fast**2))
            values += float(seen.sum()) - modes.shape[1]
            for own, left, shape in zip(
                whitener.own_rows(seen),
                whitener.own_rows(fast),
                whitener.own_rows(np.moveaxis(shaped, -1, 1)),
                strict=True,
            ):
                both = own[:, 1:] & own[:, :-1]
                products += float(np.sum(left[:, 1:] * left[:, :-1]))
                modes_of_own = np.moveaxis(shape, 1, -1)
                neighbours -= float(np.sum((modes_of_own[:, 1:] * modes_of_own[:, :-1])[both]))
                pairs += int(both.sum())
        return FastPart(square, products, values, neighbours, pairs)


def _heldout_level(prepared: PreparedStudy, rows: HeldoutRows) -> tuple[float, float]:
    """Of slow noise in the trials held out, and the degrees of freedom behind it.

    By their still frames and by what is fast in their residual, where trials differ in noise.
    """
    trials, noise_model = prepared.study.role("validate"), prepared.noise_model
    of_rest = noise_model.dof_in(trials, slow=True)
    if not prepared.levels:
        return 1.0, of_rest
    parts = prepared.by_trial(trials, rows.residual)
    fast = [FastPart.of(prepared.whiteners[name], part) for name, part in parts.items()]
    return _slow_level(noise_model, fast, of_rest)


def _slow_level(
    noise_model: NoiseModel, parts: Sequence[FastPart], of_rest: float
) -> tuple[float, float]:
    """Mean square of the noise's smooth part once whitened, 1 if the noise is right; its dof.

    of_rest  degrees of freedom of the noise's level as it was whitened for

    Noise of another correlation than it was whitened for stays correlated with the frame before,
    and is by so much stronger where it is slow.
    """
    square, products, values, neighbours, pairs = (
        sum(getattr(p, f.name) for p in parts) for f in fields(FastPart)
    )
    level = square / values
    off = (products - neighbours * level) / (level * max(pairs, 1))
    alike = noise_model.noise.effective_fraction
    ar1 = (1.0 - alike) / (1.0 + alike)
    slow = level * ((1.0 - ar1) / (1.0 - min(ar1 + off, MAX_AR1))) ** 2
    # Few pairs, as of cameras that take turns, tell little of how alike neighbours are.
    told = min(1.0, 2.0 * pairs / values)
    dof = told * values / noise_model.values_per_slow_dof
    of_both = dof + of_rest
    return (dof * slow + of_rest) / of_both, of_both


def _followed(fit: Fit, changes: FloatArray) -> FloatArray:
    """(n, p) moves of a fit's parameters that changes (n, rows) of its residual bring about."""
    solution = fit.solution
    slopes = jacobian_with_prior(fit)[:, solution.free]
    padded = np.zeros((len(slopes), len(changes)))
    padded[: changes.shape[1]] = changes.T
    moves = np.zeros((len(changes), len(solution.q)))
    moves[:, solution.free] = -np.linalg.lstsq(slopes, padded, rcond=None)[0].T
    return moves[:, : len(fit.q)]


def _coarse(prepared: PreparedStudy, white: FloatArray) -> FloatArray:
    """(n, modes of all trials) coordinates, white again, of (n, rows) in smooth functions."""
    parts = prepared.by_trial(prepared.study.role("validate"), white.T)
    return np.concatenate([_of_trial(prepared.whiteners[n], p) for n, p in parts.items()]).T


def _of_trial(whitener: Whitener, white: FloatArray) -> FloatArray:
    """(modes, columns) of (rows, columns) of one trial."""
    grid = white.reshape(-1, whitener.channels, whitener.frames, white.shape[1])
    parts = []
    for channel in range(whitener.channels):
        modes = whitener.smooth_modes[channel]
        parts.append(modes.T @ grid[:, channel].reshape(len(modes), -1))
    return np.concatenate(parts)
