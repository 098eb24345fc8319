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
from cell.lab.fit.corrections import REMAINDER
from cell.lab.fit.fitting import Fit, best_initial_state, fit_trials
from cell.lab.fit.heldout import HeldoutRows, heldout_rows
from cell.lab.fit.projection import jacobian_with_prior
from cell.lab.fit.systematic_error import (
    MOTIONS,
    AllTrialsFit,
    SystematicError,
    of_all_trials,
    systematic_error,
)


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
        """The expected square of values that noise and some errors shift.

        noise      (n, n) covariance by noise of level 1
        level      mean square of the noise, estimated with `dof_level` degrees of freedom
        errors     (n, k) changes by errors: each column a standard deviation in its direction
        draws      number of draws from which the errors' covariance is estimated
        """
        shared = 2.0 * level * float(np.sum((noise @ errors) * errors))
        square = level**2 * float(np.sum(noise**2)) + shared
        of_noise = level * float(np.trace(noise))
        return _of_traces(of_noise, dof_level, square, errors.T @ errors, draws)

    @staticmethod
    def of_white(
        count: float, level: float, dof_level: float, products: FloatArray, draws: int
    ) -> ExpectedSquare:
        """The same for `count` independent values; (k, k) products of the errors' changes."""
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
    """From the noise's part of tr C, and the part of tr C² that noise is a factor of."""
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
    """χ² of the smooth part of a residual, given the fit's uncertainty.

    chi2     about `count` if the model is right; inf where the cable cannot be simulated
    rows     number of values of the complete residual
    dof      degrees of freedom of the estimated residual of a right model there
    effective_dof  degrees of freedom of the scaled χ² with the variance of `chi2`; None = `count`,
             as where noise alone shifts the values
    """

    chi2: float
    count: float
    rows: int
    dof: float
    effective_dof: float | None = None

    @property
    def excess(self) -> float:
        """Excess over noise per value; below 0 by chance."""
        return self.chi2 / self.count - 1.0

    @property
    def excess_of_all(self) -> float:
        """Excess as a mean square over the complete residual, in units of the noise's."""
        return (self.chi2 - self.count) / self.rows

    @property
    def p_value(self) -> float:
        """p-value of the excess under noise alone."""
        return self.p_value_of(self.excess)

    def p_value_of(self, excess: float) -> float:
        """p-value that such an excess over noise would have."""
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
    if not noise_is_from_rest(prepared) or not prepared.study.role("validate"):
        return None
    rows = heldout_rows(prepared, fit)
    if not (np.all(np.isfinite(rows.residual)) and np.all(np.isfinite(rows.spread))):
        return SmoothPart(np.inf, 1, len(rows.residual), prepared.noise_model.slow_dof)
    coarse = _coarse(prepared, rows.residual[None])
    level, dof = _heldout_level(prepared, rows)
    chi2 = marginal_chi2(coarse[0], _coarse(prepared, rows.spread.T).T)[0] / level
    return SmoothPart(chi2, coarse.shape[1], len(rows.residual), dof)


def noise_is_from_rest(prepared: PreparedStudy) -> bool:
    """Whether the noise level is from frames at rest: not stated, nor a model's error."""
    return prepared.noise_is_measured and not prepared.noise_model.stated


@once_per_study
def without_systematic_error(prepared: PreparedStudy, fit: Fit) -> SmoothPart | None:
    """As `smooth_part`, without mesh error and gripper-log error.

    To first order: the parameters absorb part of the change by mesh and log in the fitted trials;
    the remainder appears in the held-out trials.
    """
    part = smooth_part(prepared, fit)
    if part is None or not np.isfinite(part.chi2):
        return part
    rows, held = heldout_rows(prepared, fit), prepared.study.role("validate")
    initial_states = {
        **fit.initial_states,
        **{t.name: best_initial_state(prepared, fit.model, t) for t in held},
    }
    held_error = systematic_error(prepared, replace(fit, initial_states=initial_states), held)
    fit_error = systematic_error(prepared, fit, fit_trials(prepared))
    mesh = held_error.mesh + _absorbed(fit, fit_error.mesh[None])[0] @ rows.by_parameters.T
    difference = (
        held_error.full_mesh + _absorbed(fit, fit_error.full_mesh[None])[0] @ rows.by_parameters.T
    )
    changes = [REMAINDER * difference[None], *_each_alone(held_error)]
    changes += [_absorbed(fit, alone) @ rows.by_parameters.T for alone in _each_alone(fit_error)]
    residual = (rows.residual + (1.0 + REMAINDER) * mesh)[None]
    coarse = _coarse(prepared, np.concatenate([residual, *changes]))
    products = marginal_products(coarse, _coarse(prepared, rows.spread.T).T)
    level = _heldout_level(prepared, rows)
    expected = ExpectedSquare.of_white(part.count, *level, products[1:, 1:], MOTIONS)
    chi2 = float(products[0, 0]) * part.count / expected.mean
    return replace(part, chi2=chi2, dof=expected.dof_mean, effective_dof=expected.dof)


def _each_alone(errors: SystematicError) -> list[FloatArray]:
    """(motions, rows) of changes by gripper-log error in one trial only, for each trial."""
    changes = []
    for part in np.split(np.arange(errors.gripper_motions.shape[1]), errors.ends[:-1]):
        alone = np.zeros_like(errors.gripper_motions)
        alone[:, part] = errors.gripper_motions[:, part] / np.sqrt(MOTIONS)
        changes.append(alone)
    return changes


@dataclass(frozen=True, eq=False)
class AllTrialsResidual:
    """The residual of a model fitted to all trials, and its systematic error.

    components  (1 + errors + basis, rows): the residual less the mesh's error, projected off the
                parameters; its possible changes by mesh and gripper log; the parameters' basis.
                The prior's rows come last
    """

    all_trials: AllTrialsFit
    whiteners: list[Whitener]
    components: FloatArray
    errors: int

    @cached_property
    def by_trial(self) -> list[tuple[Whitener, FloatArray]]:
        """`components` of each trial, (…, rows of the trial)."""
        parts = self.all_trials.systematic_error.by_trial(self.components)
        return list(zip(self.whiteners, parts, strict=True))

    @cached_property
    def level(self) -> tuple[float, float]:
        """Level of slow noise and its degrees of freedom; as stated, if it is."""
        noise_model = self.all_trials.prepared.noise_model
        if not noise_is_from_rest(self.all_trials.prepared):
            return 1.0, np.inf
        fast = [FastPart.of(w, p[0]) for w, p in self.by_trial]
        return _slow_level(noise_model, fast, noise_model.slow_dof)

    def part(self, coordinates: Callable[[Whitener, FloatArray], FloatArray]) -> SmoothPart:
        """χ² in orthonormal directions of each trial: (directions, n) coordinates of (rows, n)."""
        return self.test(np.concatenate([coordinates(w, p.T) for w, p in self.by_trial]))

    def half_shows_from(self, noise: FloatArray, directions: FloatArray, p: float) -> float:
        """χ² in directions (n, rows) whose half would have this p-value.

        noise  (n, n) their covariance by noise, projected off the parameters
        """
        rows = self.all_trials.systematic_error.ends[-1]
        errors = directions @ self.components[1 : 1 + self.errors, :rows].T
        expected = ExpectedSquare.of(noise, 1.0, self.level[1], errors, MOTIONS)
        return 2.0 * expected.exceeded_with(p) - expected.mean

    def test(self, coarse: FloatArray) -> SmoothPart:
        """χ² from (directions, 1 + errors + basis) orthonormal coordinates of `components`."""
        residual, errors, basis = np.split(coarse, [1, 1 + self.errors], axis=1)
        noise = np.eye(len(coarse)) - basis @ basis.T
        expected = ExpectedSquare.of(noise, *self.level, errors, MOTIONS)
        count = float(np.trace(noise))
        chi2 = float(np.sum(residual**2)) * count / expected.mean
        rows = sum(w.count for w in self.whiteners)
        return SmoothPart(chi2, count, rows, expected.dof_mean, expected.dof)


@once_per_study
def all_trials_residual(prepared: PreparedStudy, fit: Fit) -> AllTrialsResidual | None:
    """The residual of the model refitted to all trials; None if one cannot be simulated."""
    refit = of_all_trials(prepared, fit)
    if refit is None:
        return None
    linear, systematic, trials = refit.linear, refit.systematic_error, fit_trials(refit.prepared)
    changes = np.concatenate([systematic.full_mesh[None] * REMAINDER, *_each_alone(systematic)])
    behind = len(linear.residual) - systematic.ends[-1]  # the prior's rows
    errors = linear.remove(np.pad(changes, ((0, 0), (0, behind))))
    components = np.vstack([linear.residual, errors, linear.basis.T])
    whiteners = [refit.prepared.whiteners[t.name] for t in trials]
    return AllTrialsResidual(refit, whiteners, components, len(errors))


@dataclass(frozen=True)
class FastPart:
    """White residuals of a trial without their smooth part: sums over frames and channels.

    square, products    sums of squares, and of products with the value of the previous frame
    values, neighbours  expected values of these two sums for white noise of unit size
    """

    square: float
    products: float
    values: float
    neighbours: float
    pairs: int

    @staticmethod
    def of(whitener: Whitener, white: FloatArray) -> FastPart:
        """The sums of one trial's whitened residual (rows,)."""
        grid = white.reshape(-1, whitener.channels, whitener.frames)
        square = products = values = neighbours = 0.0
        pairs = 0
        for channel in range(whitener.channels):
            modes = whitener.smooth_modes[channel]
            series = grid[:, channel]
            fast = series - (modes @ (modes.T @ series.ravel())).reshape(series.shape)
            observed = whitener.observed[..., channel].T
            fast = np.where(observed, fast, 0.0)
            shaped = modes.reshape(*series.shape, -1)
            square += float(np.sum(fast**2))
            values += float(observed.sum()) - modes.shape[1]
            for own, own_fast, shape in zip(
                whitener.own_rows(observed),
                whitener.own_rows(fast),
                whitener.own_rows(np.moveaxis(shaped, -1, 1)),
                strict=True,
            ):
                paired = own[:, 1:] & own[:, :-1]
                products += float(np.sum(own_fast[:, 1:] * own_fast[:, :-1]))
                modes_of_own = np.moveaxis(shape, 1, -1)
                neighbours -= float(np.sum((modes_of_own[:, 1:] * modes_of_own[:, :-1])[paired]))
                pairs += int(paired.sum())
        return FastPart(square, products, values, neighbours, pairs)


def _heldout_level(prepared: PreparedStudy, rows: HeldoutRows) -> tuple[float, float]:
    """Level of slow noise in the held-out trials, and its degrees of freedom.

    From their frames at rest and the fast part of their residual, where trials differ in noise.
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
    """Mean square of the smooth part of whitened noise, 1 if the noise model is right; its dof.

    of_rest  degrees of freedom of the noise level that was used for whitening

    If the true autocorrelation is larger than assumed, whitened noise stays correlated with the
    previous frame, and is stronger at low frequencies.
    """
    square, products, values, neighbours, pairs = (
        sum(getattr(p, f.name) for p in parts) for f in fields(FastPart)
    )
    level = square / values
    off = (products - neighbours * level) / (level * max(pairs, 1))
    independent = noise_model.noise.effective_fraction
    ar1 = (1.0 - independent) / (1.0 + independent)
    slow = level * ((1.0 - ar1) / (1.0 - min(ar1 + off, MAX_AR1))) ** 2
    # Few pairs, as from alternating cameras, give little information about the autocorrelation.
    weight = min(1.0, 2.0 * pairs / values)
    dof = weight * values / noise_model.values_per_slow_dof
    of_both = dof + of_rest
    return (dof * slow + of_rest) / of_both, of_both


def _absorbed(fit: Fit, changes: FloatArray) -> FloatArray:
    """(n, p) changes of a fit's parameters caused by changes (n, rows) of its residual."""
    solution = fit.solution
    jacobian = jacobian_with_prior(fit)[:, solution.free]
    padded = np.zeros((len(jacobian), len(changes)))
    padded[: changes.shape[1]] = changes.T
    moves = np.zeros((len(changes), len(solution.q)))
    moves[:, solution.free] = -np.linalg.lstsq(jacobian, padded, rcond=None)[0].T
    return moves[:, : len(fit.q)]


def _coarse(prepared: PreparedStudy, white: FloatArray) -> FloatArray:
    """(n, modes of all trials) white coordinates of whitened (n, rows) in smooth modes."""
    parts = prepared.by_trial(prepared.study.role("validate"), white.T)
    return np.concatenate([_coordinates(prepared.whiteners[n], p) for n, p in parts.items()]).T


def _coordinates(whitener: Whitener, white: FloatArray) -> FloatArray:
    """(modes, columns) coordinates of one trial's (rows, columns)."""
    grid = white.reshape(-1, whitener.channels, whitener.frames, white.shape[1])
    parts = []
    for channel in range(whitener.channels):
        modes = whitener.smooth_modes[channel]
        parts.append(modes.T @ grid[:, channel].reshape(len(modes), -1))
    return np.concatenate(parts)
