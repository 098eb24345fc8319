"""Sensitivities of a fitted study to effects: derivatives by amplitude, for guessed shapes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect, Effect, Parameter
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.fit.projection import Projection, nuisance_of

#: Amplitudes are perturbed by this share of their typical size: a slope may vanish at zero.
PERTURBATION = 0.05


#: A perturbation is too large for a slope if it is detectable, given the parameters, at more than
#: this many standard deviations: the response is nonlinear.  In 30 studies that holds for all 79
#: that moved a marker by more than 300 times the noise.  It is reduced, at most this often.
MOST_SHOWN, TRIES = 10.0, 6


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of the fit trials in an effect's amplitudes, at zero.

    values  per guess of its shape parameters, all parameters
    rows    (shapes, amplitudes, values) whitened change per unit of each amplitude, the prior's
            rows (zero) included; zero where it cannot be simulated
    """

    effect: type[Effect]
    values: tuple[FloatArray, ...]
    rows: FloatArray


def sensitivities(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> list[Sensitivity]:
    """Sensitivities of the fit trials to every effect's amplitudes, at every guess of its shape."""
    guesses = [g for effect in effects for g in _guesses(effect)]
    nuisance, measured = nuisance_of(fit), len(fit.solution.residual)
    rows = np.full((len(guesses), len(nuisance.residual)), np.nan)
    rows[:, measured:] = 0.0  # those of the prior
    pending = list(range(len(guesses)))
    for attempt in range(TRIES):
        rows[pending, :measured] = changes(
            prepared, fit, [ActiveEffect(guesses[i].effect, guesses[i].values) for i in pending]
        )
        shares = {i: _share_of_slope(nuisance, rows[i]) for i in pending}
        pending = [i for i in pending if shares[i] < 1.0]
        if not pending or attempt == TRIES - 1:
            break
        for i in pending:
            guesses[i] = guesses[i].smaller(shares[i])
    rows[~np.all(np.isfinite(rows), axis=1)] = 0.0
    rows /= np.array([g.perturbation for g in guesses])[:, None]
    result = []
    for effect in effects:
        own = [i for i, g in enumerate(guesses) if g.effect is effect]
        shapes = len({guesses[i].shape for i in own})
        grouped = rows[own].reshape(shapes, -1, rows.shape[1])
        values = tuple(
            np.array(guesses[own[shape * grouped.shape[1]]].values) for shape in range(shapes)
        )
        result.append(Sensitivity(effect, values, grouped))
    return result


def one_sided(effect: type[Effect]) -> bool:
    """Whether an effect has exactly one amplitude, of a single sign."""
    amplitudes = [p for p in effect.parameters if p.amplitude]
    return len(amplitudes) == 1 and amplitudes[0].low >= amplitudes[0].default


@dataclass(frozen=True)
class _Guess:
    """One simulation: one amplitude perturbed, the other parameters as guessed."""

    effect: type[Effect]
    shape: int
    values: tuple[float, ...]
    which: int
    perturbation: float

    def smaller(self, share: float) -> _Guess:
        """The guess with a share of the perturbation, for a very sensitive cable."""
        default = self.effect.parameters[self.which].default
        smaller = share * self.perturbation
        values = (*self.values[: self.which], default + smaller, *self.values[self.which + 1 :])
        return _Guess(self.effect, self.shape, values, self.which, smaller)


def _share_of_slope(nuisance: Projection, row: FloatArray) -> float:
    """Factor by which a perturbation must be reduced for a slope; 1 = it is small enough.

    row  (values,) its whitened change, the prior's rows included; not finite where it cannot be
         simulated
    """
    if not np.all(np.isfinite(row)):
        return 0.1
    shown = float(np.linalg.norm(nuisance.remove(row)))
    return 1.0 if shown <= MOST_SHOWN else 0.5 * MOST_SHOWN / shown


def changes(prepared: PreparedStudy, fit: Fit, active: Sequence[ActiveEffect]) -> FloatArray:
    """(effects, rows) whitened change of the fit trials' markers, by each effect alone."""
    model = fit.model
    models = [model, *(replace(model, effects=(*model.effects, a)) for a in active)]
    initial_states = {
        name: np.tile(values, (len(models), 1)) for name, values in fit.initial_states.items()
    }
    white = prepared.white_near(fit_trials(prepared), models, initial_states)
    return np.asarray(white[0] - white[1:])


def _guesses(effect: type[Effect]) -> list[_Guess]:
    """Every amplitude at every combination of starts of the shape parameters, shape by shape."""
    if not any(p.amplitude for p in effect.parameters):
        raise ValueError(f"effect {effect.name}: no parameter switches it off; declare one")
    guesses = []
    for shape, values in enumerate(_shapes(effect)):
        for i, p in enumerate(effect.parameters):
            if p.amplitude:
                perturbation = _perturbation(p)
                perturbed = (*values[:i], p.default + perturbation, *values[i + 1 :])
                guesses.append(_Guess(effect, shape, perturbed, i, perturbation))
    return guesses


def _shapes(effect: type[Effect]) -> list[tuple[float, ...]]:
    """Parameters of every shape to be tested, amplitudes zero."""
    choices = [p.starts if is_shape(p) else (p.default,) for p in effect.parameters]
    usual = list(itertools.product(*choices))
    scanned = [
        (*usual[0][:i], value, *usual[0][i + 1 :])
        for i, p in enumerate(effect.parameters)
        for value in p.scan
    ]
    return usual + scanned


def shape_count(effect: type[Effect]) -> int:
    """Number of shapes in the correction for multiple testing: about three per shape parameter."""
    return int(3 ** sum(map(is_shape, effect.parameters)) * len(_shapes(effect)))


def shapes_of(effect: type[Effect]) -> int:
    """Number of start shapes of an effect."""
    return int(np.prod([len(p.starts) for p in effect.parameters if is_shape(p)]))


def is_shape(parameter: Parameter) -> bool:
    """Whether a parameter is fitted and is not an amplitude."""
    return parameter.fitted and not parameter.amplitude


def _perturbation(parameter: Parameter) -> float:
    size = PERTURBATION * max(abs(s - parameter.default) for s in parameter.starts[:1])
    size = size or PERTURBATION * (parameter.high - parameter.low)
    return size if parameter.default + size <= parameter.high else -size
