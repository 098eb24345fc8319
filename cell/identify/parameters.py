"""The numbers that a fit may change: coordinates, bounds and prior of baseline and effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.geometry import GRAVITY_M_PER_S2, Cable
from cell.cable.model import CableModel, knot_basis


def one_sided_steps(q: FloatArray, step: FloatArray, high: FloatArray) -> FloatArray:
    """(p,) steps from q, forward unless that would leave the bounds.

    q, step, high  (p,) point, size of the steps > 0, upper bounds
    """
    return np.where(q + step <= high, step, -step)


#: A difference over less than this share of a parameter's usual step is lost in rounding.
FINEST = 1e-4


def within_deviations(step: FloatArray, std: FloatArray) -> FloatArray:
    """(p,) steps that reach no further than the standard deviations (p,), where these are known.

    A difference over more than a standard deviation may have the wrong sign: a ringing's onset,
    known to 20 µs, was moved by 5 ms.
    """
    return np.where(std > 0.0, np.clip(std, FINEST * step, step), step)


def difference_points(q: FloatArray, steps: FloatArray) -> FloatArray:
    """(1 + p, p) the point q and its neighbours, each with one parameter moved."""
    return np.vstack([q, q + np.diag(steps)])


@dataclass(frozen=True)
class Prior:
    """Knowledge of a cable before it is measured; sizes relative to its own weight.

    knots               of log EI(s), equally spaced
    rigidity_log_std    std of the mean log EI, about 0.4·ρ g L³ (a cable that droops by a fifth)
    rigidity_log_walk   std of the change of log EI over the full length, as a random walk
    exponent_std        std of N about 1
    viscosity_log_std   std of log C, about EI·0.04·√(L/g) (5 % damping in the first mode)
    effect_std          std of an effect's parameter about its default, relative to its typical
                        starting value
    """

    knots: int = 6
    rigidity_log_std: float = 2.0
    rigidity_log_walk: float = 0.4
    exponent_std: float = 0.2
    viscosity_log_std: float = 1.5
    effect_std: float = 10.0

    def __post_init__(self) -> None:
        if self.knots < 2:
            raise ValueError(f"prior.knots = {self.knots}: must be ≥ 2")
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"prior.{name} = {value}: must be finite and > 0")


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """Fit coordinates q (p,): log EI at the knots, N, log C, then the effects' parameters.

    names, units  of the natural values; effects' parameters are called `effect.parameter`
    logarithmic   (p,) whether q is the logarithm of the natural value
    mean, precision   (p,), (p, p) of the Gaussian prior of q
    low, high     (p,) bounds of q
    step          (p,) of finite differences
    exact         effects' parameters that are no coordinates: name → natural value
    pull_m_per_s2  acceleration in place of gravity for the prior and the start of a fit; None =
                  gravity
    """

    cable: Cable
    gravity_m_per_s2: tuple[float, float]
    knots: int
    effects: tuple[type[Effect], ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    logarithmic: NDArray[np.bool_]
    mean: FloatArray
    precision: FloatArray
    low: FloatArray
    high: FloatArray
    step: FloatArray
    exact: tuple[tuple[str, float], ...] = ()
    pull_m_per_s2: float | None = None

    @property
    def scale_m_per_s2(self) -> float:
        """Acceleration whose load on the cable is comparable to its stiffness, m/s²."""
        if self.pull_m_per_s2 is not None:
            return self.pull_m_per_s2
        return float(np.hypot(*self.gravity_m_per_s2))

    @classmethod
    def of(
        cls,
        cable: Cable,
        *,
        gravity_m_per_s2: tuple[float, float] = GRAVITY_M_PER_S2,
        effects: Sequence[type[Effect]] = (),
        prior: Prior = Prior(),
        exact: Mapping[str, float] | None = None,
        pull_m_per_s2: float | None = None,
    ) -> ParameterSpace:
        """Baseline plus `effects`, with a weak prior.

        exact          natural values of effects' parameters that no fit may change, by
                       `effect.parameter`
        pull_m_per_s2  in place of gravity where that is weak, see the class
        """
        held = dict(exact or {})
        k = prior.knots
        scale = float(np.hypot(*gravity_m_per_s2)) if pull_m_per_s2 is None else pull_m_per_s2
        weight_n_per_m = cable.loaded_density_kg_per_m * scale
        if weight_n_per_m == 0.0:
            raise ValueError("gravity is 0, and no swing tells what the cable is as stiff as")
        log_rigidity = float(np.log(0.4 * weight_n_per_m * cable.free_length_m**3))
        time_s = 0.04 * float(np.sqrt(cable.free_length_m / scale))
        change = np.diff(np.eye(k), axis=0)
        walk = prior.rigidity_log_walk / np.sqrt(k - 1)
        rigidity_precision = change.T @ change / walk**2 + np.full(
            (k, k), (k * prior.rigidity_log_std) ** -2.0
        )

        log_viscosity = log_rigidity + float(np.log(time_s))
        # name, unit, whether logarithmic, mean, std (that of EI comes as a matrix), low, high, step
        span = log_rigidity - 8.0, log_rigidity + 8.0
        rows: list[tuple[str, str, bool, float, float, float, float, float]] = [
            *((f"rigidity_{i}", "N·m²", True, log_rigidity, 0.0, *span, 1e-4) for i in range(k)),
            ("exponent", "1", False, 1.0, prior.exponent_std, 0.3, 3.0, 1e-4),
        ]
        span, std = (log_viscosity - 12.0, log_viscosity + 8.0), prior.viscosity_log_std
        rows.append(("viscosity", "N·m²·s", True, log_viscosity, std, *span, 1e-4))
        for effect in effects:
            for p in effect.parameters:
                name = f"{effect.name}.{p.name}"
                if name in held:
                    continue
                if p.low > 0.0:
                    middle, least, most = (float(np.log(v)) for v in (p.default, p.low, p.high))
                    rows.append((name, p.unit, True, middle, 2.0, least, most, 1e-3))
                    continue
                size = max(abs(start - p.default) for start in p.starts) or abs(p.default) or 1.0
                std = prior.effect_std * size
                rows.append((name, p.unit, False, p.default, std, p.low, p.high, 1e-3 * size))
        names, units, logarithmic, mean, stds, low, high, step = zip(*rows, strict=True)
        precision = np.diag(np.concatenate([np.zeros(k), np.array(stds[k:]) ** -2.0]))
        precision[:k, :k] = rigidity_precision
        return cls(
            cable,
            gravity_m_per_s2,
            k,
            tuple(effects),
            names,
            units,
            np.array(logarithmic),
            np.array(mean),
            precision,
            np.array(low),
            np.array(high),
            np.array(step),
            tuple(held.items()),
            pull_m_per_s2,
        )

    @property
    def rigidity_is_unknown(self) -> bool:
        """Whether EI(s) has only the weak prior that it changes little along the cable."""
        k, usual = self.knots, self._usual(self.knots)
        known = self.precision[:k].copy()
        known[:, :k] -= usual.precision[:k, :k]
        return not known.any() and bool(np.all(self.mean[:k] == usual.mean[:k]))

    def with_knots(self, knots: int) -> ParameterSpace:
        """The same with log EI at so many knots, with the weak prior."""
        k, usual = self.knots, self._usual(knots)
        precision = np.zeros((knots + len(self.names) - k,) * 2)
        precision[:knots, :knots] = usual.precision[:knots, :knots]
        precision[knots:, knots:] = self.precision[k:, k:]

        def joined(of_rigidity: FloatArray, others: FloatArray) -> FloatArray:
            return np.concatenate([of_rigidity[:knots], others[k:]])

        return replace(
            self,
            knots=knots,
            names=usual.names[:knots] + self.names[k:],
            units=usual.units[:knots] + self.units[k:],
            logarithmic=np.concatenate([usual.logarithmic[:knots], self.logarithmic[k:]]),
            mean=joined(usual.mean, self.mean),
            precision=precision,
            low=joined(usual.low, self.low),
            high=joined(usual.high, self.high),
            step=joined(usual.step, self.step),
        )

    def _usual(self, knots: int) -> ParameterSpace:
        """The space of such a cable with the weak prior and without effects."""
        return ParameterSpace.of(
            self.cable,
            gravity_m_per_s2=self.gravity_m_per_s2,
            prior=Prior(knots=knots),
            pull_m_per_s2=self.pull_m_per_s2,
        )

    def at_knots(self, q: FloatArray, knots: int) -> FloatArray:
        """Coordinates q (p,) of the same cable in a space with so many knots.

        EI(s) is the same where they are a multiple of its own intervals, else its nearest spline.
        """
        basis = knot_basis(self.knots, tuple(np.linspace(0.0, 1.0, knots)))
        return np.concatenate([basis @ q[: self.knots], q[self.knots :]])

    def natural(self, q: FloatArray) -> FloatArray:
        """(…, p) natural values of fit coordinates."""
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, q, 0.0)), q)

    def coordinates(self, natural: FloatArray) -> FloatArray:
        """(…, p) fit coordinates of natural values."""
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, natural, 1.0)), natural)

    def model(self, q: FloatArray) -> CableModel:
        """The cable with fit coordinates q (p,)."""
        natural = self.natural(q)
        k = self.knots
        values = dict(zip(self.names[k + 2 :], natural[k + 2 :].tolist(), strict=True))
        values.update(self.exact)
        active = []
        for effect in self.effects:
            inside = {
                p.name: min(max(values[f"{effect.name}.{p.name}"], p.low), p.high)
                for p in effect.parameters
            }
            active.append(effect.active(**inside))
        return CableModel(
            self.cable,
            natural[:k],
            float(natural[k]),
            float(natural[k + 1]),
            self.gravity_m_per_s2,
            tuple(active),
        )

    def difference_steps(self, q: FloatArray, covariance: FloatArray | None = None) -> FloatArray:
        """(p,) steps from q for one-sided finite differences within the bounds.

        covariance  (p, p) of the coordinates, if it is known: no step is larger than its deviations
        """
        std = np.zeros(len(q)) if covariance is None else np.sqrt(np.abs(np.diag(covariance)))
        return one_sided_steps(q, within_deviations(self.step, std), self.high)

    def start(self, rigidity_n_m2: float) -> FloatArray:
        """(p,) a cable of the prior's shape, exponent and damping, as stiff as this in the middle.

        A parameter of an effect starts at its prior mean if its prior std is below half its typical
        starting value, else at that value.
        """
        q = self.mean.copy()
        shift = np.log(rigidity_n_m2) - q[: self.knots].mean()
        q[: self.knots] += shift
        q[self.knots + 1] += shift
        natural = self.natural(q)
        for effect in self.effects:
            for p in effect.parameters:
                name = f"{effect.name}.{p.name}"
                if name not in self.names:
                    continue
                i = self.names.index(name)
                size = 1.0 if self.logarithmic[i] else max(abs(v - p.default) for v in p.starts)
                if self.precision[i, i] * (0.5 * size) ** 2 < 1.0:
                    natural[i] = p.starts[0]
        return np.clip(self.coordinates(natural), self.low, self.high)
