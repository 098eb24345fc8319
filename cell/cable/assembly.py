"""Models → blocks of lanes in the layout of the compiled code."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable import layout as at
from cell.cable.arrays import FloatArray
from cell.cable.compiling import WIDEST
from cell.cable.effects.base import ActiveEffect, Effect
from cell.cable.effects.compiled import Hooks, cable_data, hooks_of, in_steps, parameters
from cell.cable.effects.own import with_compiled_hooks
from cell.cable.model import CableModel, knot_basis

#: Discretisation error of a held cable's tip: see `docs/explain/model.md`, "Accuracy".
DEFAULT_SEGMENTS = 28


@dataclass(frozen=True)
class ParameterBlock:
    """Up to LANES models whose steps call the same effects, ready to run.

    lanes      their numbers in the batch
    width      computed lanes: those above, padded to full vectors with copies of the first
    state      flat, see `layout`
    lengths    (LANES,) length of a segment, m
    effects    argument of the compiled functions, see `Hooks.arguments`
    own        a user's effects whose hooks these functions call
    """

    lanes: tuple[int, ...]
    width: int
    segments: int
    state: FloatArray
    lengths: FloatArray
    nonlinear: bool
    iterations: int
    effects: tuple[Any, ...]
    own: tuple[type[Effect], ...]

    def resume_from(self, trunk: Sequence[ParameterBlock]) -> None:
        """Copy the state of the same models from blocks with fewer lanes.

        trunk  blocks whose lanes are models; lane i of this batch has model i modulo their number
        """
        place = {lane: (block, k) for block in trunk for k, lane in enumerate(block.lanes)}
        order = self.lanes + self.lanes[:1] * (at.LANES - len(self.lanes))
        for k, lane in enumerate(order):
            block, there = place[lane % len(place)]
            for mine, its in ((self.state, block.state), (self._memory, block._memory)):
                mine.reshape(-1, at.LANES)[:, k] = its.reshape(-1, at.LANES)[:, there]

    @property
    def _memory(self) -> FloatArray:
        """Memory variables of the effects; lanes innermost."""
        memory: FloatArray = self.effects[4]
        return memory


def assemble(
    models: Sequence[CableModel], segments: int, start_s: float, threads: int = 1
) -> list[ParameterBlock]:
    """Blocks for all models; those whose steps call different effects go to different blocks."""
    if segments < 4:
        raise ValueError(f"segments = {segments}: must be ≥ 4")
    groups: dict[object, list[int]] = {}
    for i, model in enumerate(models):
        groups.setdefault(_kind(model), []).append(i)
    blocks = []
    for members in groups.values():
        hooks = hooks_of(models[members[0]].effects)
        width = at.VECTOR if len(members) <= at.VECTOR * threads else at.LANES
        for first in range(0, len(members), width):
            lanes = tuple(members[first : first + width])
            blocks.append(_block([models[i] for i in lanes], lanes, segments, hooks, start_s))
    return blocks


def _kind(model: CableModel) -> object:
    """Key that is equal for models that may share a block: same steps, same kind of image times."""
    at_times = any(a.effect.camera_time is not None for a in model.effects)
    return at_times, tuple(a.effect for a in in_steps(model.effects))


def _block(
    batch: list[CableModel], lanes: tuple[int, ...], n: int, hooks: Hooks, start_s: float
) -> ParameterBlock:
    state = at.vectors(n + 1, at.FIELDS)
    models = list({id(model): model for model in batch}.values())  # each once
    w = len(models)

    def each(value: Any) -> FloatArray:
        return np.array([value(m) for m in models], dtype=np.float64)

    total = each(_total_length_m)
    if any(slipped_out(m) for m in models):
        raise ValueError("extra_length of the effects leaves less than a tenth of the cable")
    length = total / n
    compliance, lag = np.array([_grip(m) for m in models]).T

    part = np.ones((n + 1, 1))
    part[0] = part[-1] = 0.5
    body = part * length
    hinge_fraction = np.concatenate(([0.0], (np.arange(1, n + 1) - 0.5) / n))
    middle_fraction = np.concatenate(([0.25], np.arange(1, n), [n - 0.25])) / n
    # Euler–Maclaurin at the clamp: bends then add up to the angle of the curve to O(l⁴), instead of
    # O(l²).  None is needed at the tip, where curvature and its slope vanish.
    end = np.ones((n + 1, 1))
    end[1:4, 0] = 26.0 / 24.0, 21.0 / 24.0, 25.0 / 24.0

    def put(field: int, value: Any) -> None:
        state[:, field, :w] = value

    power = 0.5 * (each(lambda m: m.exponent) - 1.0)
    put(at.RIGIDITY, np.exp(_log_rigidity(models, hinge_fraction)))
    put(at.PER_LENGTH, 1.0 / (end * length))
    put(at.VISCOSITY, each(lambda m: m.viscosity_n_m2_s))
    put(at.POWER, power)
    arc_hinge = hinge_fraction[:, None] * total
    put(at.ARC_HINGE, arc_hinge)
    put(at.ARC_MIDDLE, middle_fraction[:, None] * total)
    if any(model.effects for model in models):
        for i, model in enumerate(models):
            state[:, at.REST, i] = _rest(model, arc_hinge[:, i])
    put(at.FREE, 1.0)
    state[0, at.FREE, :w] = compliance > 0.0
    state[0, at.SPRING, :w] = 1.0 / np.where(compliance > 0.0, compliance, 1.0)
    state[0, at.VISCOSITY, :w] = state[0, at.SPRING, :w] * lag
    _put_masses(state, models, body)
    gravity = np.array([m.gravity_m_per_s2 for m in models]).reshape(w, 2)
    put(at.GX, gravity[:, 0])
    put(at.GY, gravity[:, 1])
    place = {id(model): k for k, model in enumerate(models)}
    order = [place[id(model)] for model in batch] + [0] * (at.LANES - len(batch))
    state[:] = state[:, :, order]
    return ParameterBlock(
        lanes,
        -(-len(batch) // WIDEST) * WIDEST,
        n,
        state.ravel(),
        length[order],
        bool(np.any(power != 0.0)),
        hooks.iterations,
        hooks.arguments(batch, n, start_s),
        with_compiled_hooks(a.effect for a in models[0].effects),
    )


def _log_rigidity(models: list[CableModel], fraction: FloatArray) -> FloatArray:
    """(fractions, models) log EI at fractions of the length, EI in N·m²."""
    log_rigidity = np.empty((len(fraction), len(models)))
    for k in {m.rigidity_n_m2.size for m in models}:
        basis = knot_basis(k, tuple(fraction))
        chosen = [i for i, m in enumerate(models) if m.rigidity_n_m2.size == k]
        log_rigidity[:, chosen] = basis @ np.log([models[i].rigidity_n_m2 for i in chosen]).T
    return log_rigidity


def _put_masses(state: FloatArray, models: list[CableModel], body: FloatArray) -> None:
    """Write masses, their moments and weights of the bodies (n + 1, models) of these lengths, m."""
    w = len(models)
    density = np.array([m.cable.line_density_kg_per_m for m in models], dtype=np.float64)
    inertia = np.array([_inertia(m) for m in models]).reshape(w, 2)
    tip = np.array([_sum(m, "tip_mass") for m in models], dtype=np.float64)

    def put(field: int, value: Any) -> None:
        state[:, field, :w] = value

    along = density + inertia[:, 0]
    extra = inertia[:, 1] - inertia[:, 0]
    put(at.LENGTH, body)
    put(at.MASS, along * body)
    put(at.MASS_1, along * body**2 / 2.0)
    put(at.MASS_2, along * body**3 / 3.0)
    put(at.EXTRA, extra * body)
    put(at.EXTRA_1, extra * body**2 / 2.0)
    put(at.EXTRA_2, extra * body**3 / 3.0)
    put(at.WEIGHT, density * body)
    put(at.WEIGHT_1, density * body**2 / 2.0)
    for lane, model in enumerate(models):
        _put_inertia(state[:, :, lane], body[:, lane], model)
        for mass_kg, arc_m in _point_masses(model):
            _put_point(state[:, :, lane], body[:, lane], mass_kg, arc_m)
    last: FloatArray = body[-1]
    for mass, centre, inertia in ((tip, last, 0.0 * last), _connectors(models, last)):
        state[-1, at.MASS, :w] += mass
        state[-1, at.MASS_1, :w] += mass * centre
        state[-1, at.MASS_2, :w] += mass * centre**2 + inertia
        state[-1, at.WEIGHT, :w] += mass
        state[-1, at.WEIGHT_1, :w] += mass * centre


#: Gauss–Legendre rule over a body: places and weights over −1 … 1.
_PLACES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


def _put_inertia(state: FloatArray, body_m: FloatArray, model: CableModel) -> None:
    """Add the inertia that varies along the cable to the bodies (n + 1)."""
    varying = [a for a in model.effects if a.effect.varies_along_cable()]
    if not varying:
        return
    half_m = 0.5 * body_m[:, None]
    within_m = half_m * (1.0 + _PLACES)
    begins_m = np.concatenate([[0.0], np.cumsum(body_m)[:-1]])
    arcs_m = (begins_m[:, None] + within_m).ravel()
    added = added_inertia(model, varying, arcs_m)
    along, normal = added.reshape(2, *within_m.shape)
    for moment, (mass, extra) in enumerate(
        ((at.MASS, at.EXTRA), (at.MASS_1, at.EXTRA_1), (at.MASS_2, at.EXTRA_2))
    ):
        weights = half_m * _WEIGHTS * within_m**moment
        state[:, mass] += np.sum(weights * along, axis=1)
        state[:, extra] += np.sum(weights * (normal - along), axis=1)


def _put_point(state: FloatArray, body_m: FloatArray, mass_kg: float, arc_m: float) -> None:
    """Add a point mass with weight at an arc length to the body (of n + 1) that it is on."""
    begins = np.concatenate([[0.0], np.cumsum(body_m)[:-1]])
    on = int(np.searchsorted(begins, arc_m, side="right")) - 1
    place = min(arc_m - float(begins[on]), float(body_m[on]))
    for moment, fields in enumerate(((at.MASS, at.WEIGHT), (at.MASS_1, at.WEIGHT_1), (at.MASS_2,))):
        for field in fields:
            state[on, field] += mass_kg * place**moment


def _connectors(
    models: list[CableModel], last_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mass, kg, place of its centre from the near end of the last body, m, and inertia, kg·m²."""
    numbers = [m.cable.numbers for m in models]
    mass, length, inertia = (
        np.array([n[f"connector.{name}"] for n in numbers])
        for name in ("mass_kg", "length_m", "inertia_kg_m2")
    )
    return mass, last_m + 0.5 * length, inertia


def slipped_out(model: CableModel) -> bool:
    """Whether the effects reduce the free length to less than a tenth, too little for a mesh."""
    return _total_length_m(model) < 0.1 * model.cable.free_length_m


def _total_length_m(model: CableModel) -> float:
    return model.cable.free_length_m + _sum(model, "extra_length")


def _results(model: CableModel, hook: str, *where: FloatArray) -> Iterator[Any]:
    """Results of a hook, of each of the model's effects that has it."""
    for active in model.effects:
        if (function := getattr(active.effect, hook)) is not None:
            yield function(cable_data(model), *where, parameters(active))


def _sum(model: CableModel, hook: str) -> float:
    total = 0.0
    for value in _results(model, hook):
        total += float(value)
    return total


def _point_masses(model: CableModel) -> list[tuple[float, float]]:
    """Mass, kg, and arc length, m, of every point mass that is not at the tip."""
    masses = _results(model, "point_mass")
    return [(float(mass), float(max(arc_m, 0.0))) for mass, arc_m in masses if mass != 0.0]


def _grip(model: CableModel) -> tuple[float, float]:
    """Compliance of the grip, rad/(N·m), and its retardation time, s."""
    total, weighted = 0.0, 0.0
    for compliance, time in _results(model, "grip_compliance"):
        total, weighted = total + compliance, weighted + compliance * time
    return total, weighted / total if total > 0.0 else 0.0


def _inertia(model: CableModel) -> FloatArray:
    """Uniform added mass per metre along and normal to the strip, kg/m."""
    uniform = [a for a in model.effects if not a.effect.varies_along_cable()]
    return np.asarray(added_inertia(model, uniform, np.zeros(1))[:, 0])


def added_inertia(
    model: CableModel, effects: Sequence[ActiveEffect], arc_length_m: FloatArray
) -> FloatArray:
    """(2, n) mass per metre that some of a model's effects add along and normal to it, kg/m.

    arc_length_m  (n,) from the gripping point
    """
    total = np.zeros((2, len(arc_length_m)))
    for active in effects:
        if (hook := active.effect.inertia) is not None:
            where = (arc_length_m,) if active.effect.varies_along_cable() else ()
            along, normal = hook(cable_data(model), *where, parameters(active))
            total[0] += along
            total[1] += normal
    return total


def _rest(model: CableModel, arc_length_m: FloatArray) -> FloatArray:
    """Rest curvature at the hinges, 1/m."""
    total = np.zeros_like(arc_length_m)
    for curvature in _results(model, "rest_curvature", arc_length_m):
        total += curvature
    return total


def marker_weights(
    models: Sequence[CableModel], arc_length_m: FloatArray, segments: int
) -> tuple[NDArray[np.int64], FloatArray]:
    """Cell of every marker and cubic Hermite weights of its two nodes and their tangents.

    returns  (markers,) indices of the cells, (markers, 5) weights; the last is the distance of a
             marker beyond the cable's end, on the connector, m
    raises   ValueError: marker beyond the cable or crossing another, or cables of different
             lengths
    """
    lengths = {(m.cable.free_length_m, m.cable.length_m) for m in models}
    if len(lengths) != 1:
        distinct = sorted({length for _, length in lengths})
        raise ValueError(f"the models' cables have different lengths {distinct} m")
    ((length, to_tip),) = lengths
    s = np.atleast_1d(np.asarray(arc_length_m, dtype=np.float64))
    bad = ~((s >= 0.0) & (s <= to_tip * (1.0 + 1e-9)))
    if s.ndim != 1 or bad.any():
        i = int(np.argmax(bad))
        raise ValueError(f"arc_length_m[{i}] = {s.flat[i]} m: must be 0 … {to_tip} m")
    turn = np.sign(np.diff(s))
    if np.any(turn == 0.0) or np.any(turn != turn[:1]):
        i = 1 + int(np.argmax((turn == 0.0) | (turn != turn[:1])))
        raise ValueError(
            f"arc_length_m[{i}] = {s[i]} m after {s[i - 1]} m: markers must run along the cable, "
            "each beyond the one before"
        )
    beyond = np.maximum(s - length, 0.0) if to_tip > length else np.zeros_like(s)
    place = (s - beyond) / length * segments
    cell = np.minimum(place.astype(np.int64), segments - 1)
    u = place - cell
    weights = np.stack(
        [
            (1.0 + 2.0 * u) * (1.0 - u) ** 2,
            u**2 * (3.0 - 2.0 * u),
            u * (1.0 - u) ** 2,
            u**2 * (u - 1.0),
            beyond,
        ],
        axis=1,
    )
    return cell, np.ascontiguousarray(weights)
