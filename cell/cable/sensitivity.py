"""How node positions depend on each parameter of a model, all in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.cable.dynamics import DEFAULT_SOLVER, Solver, simulate
from cell.cable.effects.base import ActiveEffect, Parameter
from cell.cable.geometry import Motion
from cell.cable.model import CableModel

FloatArray = NDArray[np.float64]

#: Steps of the differences, relative to a parameter's size: EI, N and C, and an effect's `starts`.
_STEP = 1e-3
#: Viscosity whose hundredth part is the step where the model has none, N·m²·s per N·m² of EI.
_TYPICAL_LOSS_S = 3e-3
#: A column below this many metres per typical amplitude is no gradient, only rounding.
_VANISHING_M = 1e-9
#: Share of an effect's typical amplitude to which it is nudged where its gradient vanishes.
_NUDGE = 0.05


@dataclass(frozen=True)
class Sensitivities:
    """names (parameters,); positions (times, markers, 2) m; jacobian (parameters, …) m per unit."""

    names: tuple[str, ...]
    positions: FloatArray
    jacobian: FloatArray


def parameter_names(model: CableModel) -> tuple[str, ...]:
    """`rigidity_n_m2[k]`, `exponent`, `viscosity_n_m2_s`, and `effect.parameter` of each effect."""
    knots = [f"rigidity_n_m2[{k}]" for k in range(model.rigidity_n_m2.size)]
    own = [f"{a.effect.name}.{p.name}" for a in model.effects for p in a.effect.parameters]
    return (*knots, "exponent", "viscosity_n_m2_s", *own)


def parameter_values(model: CableModel) -> FloatArray:
    """Values in the order of `parameter_names`."""
    own = [v for a in model.effects for v in a.values]
    return np.array([*model.rigidity_n_m2, model.exponent, model.viscosity_n_m2_s, *own])


def with_values(model: CableModel, values: Sequence[float] | FloatArray) -> CableModel:
    """The model with other values, in the order of `parameter_names`."""
    x = [float(v) for v in values]
    k = model.rigidity_n_m2.size
    effects, first = [], k + 2
    for active in model.effects:
        last = first + len(active.values)
        effects.append(ActiveEffect(active.effect, tuple(x[first:last])))
        first = last
    return replace(
        model,
        rigidity_n_m2=np.array(x[:k]),
        exponent=x[k],
        viscosity_n_m2_s=x[k + 1],
        effects=tuple(effects),
    )


def sensitivities(
    model: CableModel,
    motion: Motion,
    times_s: FloatArray,
    arc_length_m: FloatArray,
    *,
    names: Sequence[str] | None = None,
    differences: Literal["central", "forward"] = "central",
    solver: Solver = DEFAULT_SOLVER,
    start: Literal["equilibrium", "straight"] = "equilibrium",
    release_s: float | None = None,
) -> Sensitivities:
    """Derivatives of marker positions by differences between lanes of one batch.

    At a bound, such as an amplitude of zero, the difference is taken inwards.  Where an effect is
    off, the derivative to its other parameters is taken with its amplitudes nudged to 5 % of their
    typical size; so is that to an amplitude whose gradient vanishes at zero.

    names    of the parameters wanted; default all
    raises   as `dynamics.simulate`; ValueError: no such parameter
    """
    known = parameter_names(model)
    wanted = known if names is None else tuple(names)
    for name in wanted:
        if name not in known:
            raise ValueError(f"the model has no parameter {name!r}; it has {', '.join(known)}")
    scales = _scales(model)
    values = parameter_values(model)

    def run(models: list[CableModel]) -> FloatArray:
        return simulate(
            models, motion, times_s, arc_length_m, solver=solver, start=start, release_s=release_s
        )

    pairs = [
        _pair(model, values, known.index(n), scales, differences, nudged=False) for n in wanted
    ]
    lanes = [model]
    for pair in pairs:
        lanes += [m for m in pair[1:] if m is not model]
    positions = iter(run(lanes))
    here = next(positions)
    jacobian = np.empty((len(pairs), *here.shape))
    for row, (span, below, above) in enumerate(pairs):
        low = here if below is model else next(positions)
        high = here if above is model else next(positions)
        jacobian[row] = (high - low) / span
    for row, name in enumerate(wanted):
        i = known.index(name)
        parameter = scales[i][1]
        if parameter is None or not parameter.amplitude:
            continue
        if np.abs(jacobian[row]).max() * scales[i][0] / _STEP < _VANISHING_M:
            span, below, above = _pair(model, values, i, scales, differences, nudged=True)
            low, high = run([below, above])
            jacobian[row] = (high - low) / span
    return Sensitivities(wanted, here, jacobian)


def _scales(model: CableModel) -> list[tuple[float, Parameter | None]]:
    """Step of each parameter, and what it is if it is an effect's."""
    rigidity = model.rigidity_n_m2
    loss = model.viscosity_n_m2_s or _TYPICAL_LOSS_S * float(rigidity.mean())
    own = [_STEP * float(r) for r in rigidity]
    scales: list[tuple[float, Parameter | None]] = [(s, None) for s in (*own, _STEP, _STEP * loss)]
    for active in model.effects:
        for p in active.effect.parameters:
            typical = abs(p.starts[0] - p.default) if p.amplitude else abs(p.starts[0])
            scales.append((_STEP * (typical or 1.0), p))
    return scales


def _pair(
    model: CableModel,
    here: FloatArray,
    i: int,
    scales: list[tuple[float, Parameter | None]],
    differences: str,
    nudged: bool,
) -> tuple[float, CableModel, CableModel]:
    """Distance between two models that differ in parameter i, and the models."""
    values = here.copy()
    scale, parameter = scales[i]
    if parameter is not None and (nudged or not parameter.amplitude):
        nudged = _nudge(model, values, i)
    low, high = (0.0, np.inf) if parameter is None else (parameter.low, parameter.high)
    below, above = values.copy(), values.copy()
    above[i] = min(values[i] + scale, high)
    if differences == "central" or above[i] == values[i]:
        below[i] = max(values[i] - scale, low)

    def varied(x: FloatArray) -> CableModel:
        return model if x[i] == here[i] and not nudged else with_values(model, x)

    return float(above[i] - below[i]), varied(below), varied(above)


def _nudge(model: CableModel, values: FloatArray, i: int) -> bool:
    """Switch on, a little, the effect that parameter i belongs to, if it is off; whether it was."""
    first = model.rigidity_n_m2.size + 2
    for active in model.effects:
        parameters = active.effect.parameters
        own = range(first, first + len(parameters))
        if i in own:
            amplitudes = [(j, p) for j, p in zip(own, parameters, strict=True) if p.amplitude]
            if all(values[j] == p.default for j, p in amplitudes):
                for j, p in amplitudes:
                    values[j] += _NUDGE * (p.starts[0] - p.default)
                return True
        first += len(parameters)
    return False
