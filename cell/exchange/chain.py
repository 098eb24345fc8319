"""A cable's model as rigid links and hinges with springs: the mesh of the project's own engine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from cell.cable import layout as at
from cell.cable.arrays import FloatArray
from cell.cable.assembly import added_inertia, assemble
from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3, AirDrag
from cell.cable.effects.base import ActiveEffect, Effect
from cell.cable.effects.bending import StressRelaxation
from cell.cable.effects.grip import GripAngle
from cell.cable.geometry import Cable
from cell.cable.model import REFERENCE_CURVATURE_1_PER_M, REGULAR_CURVATURE_1_PER_M, CableModel
from cell.cable.statics import settle

#: Error of the tip at rest that the springs' error in curvature may cause, if it had one sign
#: everywhere, m: a tenth of the 0.1 mm that an export must keep.  In a swing the error of the
#: frequency adds up to several times as much: with a third the tip was 0.09 mm off.
TIP_ERROR_M = 1e-5
#: Most springs of a hinge, and tried ratios of successive dead bands: enough for exponents from 0.6
#: to 2 and cables of 1 m.
_MOST, _RATIOS = 16, (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)
#: Last knot over the range, beyond which the springs are linear: at the range itself an odd spline
#: has no curvature and would depart from the law.
_LINEAR_FROM = 1.5
#: Curvatures at which law and springs are compared.
_SAMPLES = 500


@dataclass(frozen=True, eq=False)
class Springs:
    """The bending law as a sum of springs: one without a dead band, the others with one each.

    M/EI = Σ a D(κ) + c D(κ)³, D(κ) = sign κ · max(|κ| − dead band, 0); κ in 1/m.

    MuJoCo has no |κ|^(N−1).  It has a hinge's spring a x + c x³, and fixed tendons whose spring
    begins beyond a dead band.  Their sum is an odd cubic spline that is linear beyond the last
    knot, and approximates the law to any accuracy.

    dead_band_1_per_m  (k,), the first is 0
    linear             (k,) a, no unit
    cubic_m2           (k,) c, m²
    error_1_per_m      root mean square of the error, as curvature, up to `range_1_per_m`
    """

    dead_band_1_per_m: FloatArray
    linear: FloatArray
    cubic_m2: FloatArray
    error_1_per_m: float
    range_1_per_m: float

    def __call__(self, curvature_1_per_m: FloatArray) -> FloatArray:
        """M/EI at curvatures (…), 1/m."""
        size = np.abs(np.asarray(curvature_1_per_m))[..., None] - self.dead_band_1_per_m
        beyond = np.maximum(size, 0.0)
        moment = beyond @ self.linear + beyond**3 @ self.cubic_m2
        return np.asarray(np.sign(curvature_1_per_m) * moment)


def law(curvature_1_per_m: FloatArray, exponent: float) -> FloatArray:
    """M/EI of the model at curvatures (…), 1/m; see `CableModel`."""
    k = np.asarray(curvature_1_per_m, dtype=np.float64)
    scale = (k**2 + REGULAR_CURVATURE_1_PER_M**2) / REFERENCE_CURVATURE_1_PER_M**2
    return np.asarray(k * scale ** (0.5 * (exponent - 1.0)))


@lru_cache(maxsize=8)  # of one model and each number of links
def springs_for(exponent: float, length_m: float) -> Springs:
    """The fewest springs whose error moves the tip by less than `TIP_ERROR_M`.

    They approximate the law up to the curvature of a cable bent to half a circle; a little beyond
    it they are linear.
    """
    reach = math.pi / length_m
    if exponent == 1.0:
        return Springs(np.zeros(1), np.ones(1), np.zeros(1), 0.0, reach)
    allowed = 2.0 * TIP_ERROR_M / length_m**2
    for number in range(3, _MOST + 1):
        tried = [_fit_springs(exponent, reach, number, ratio) for ratio in _RATIOS]
        best = min(tried, key=lambda s: s.error_1_per_m)
        if best.error_1_per_m <= allowed:
            break
    return best


def _fit_springs(exponent: float, reach: float, number: int, ratio: float) -> Springs:
    """Least squares in curvature: error of the moment over the secant stiffness there."""
    bands = np.concatenate([[0.0], _LINEAR_FROM * reach / ratio ** np.arange(number - 2, -1, -1.0)])
    k = np.linspace(0.0, reach, _SAMPLES + 1)[1:]
    moment = law(k, exponent)
    beyond = np.maximum(k[:, None] - bands, 0.0)
    terms = np.hstack([beyond, beyond**3 / reach**2])
    # beyond the last dead band the cubic and the quadratic terms of all springs cancel
    cancel = np.zeros((2, 2 * number))
    cancel[0, number:], cancel[1, number:] = 1.0, bands / reach
    free = np.linalg.qr(cancel.T, mode="complete")[0][:, 2:]
    weight = k / moment
    solved = np.linalg.lstsq((terms @ free) * weight[:, None], moment * weight, rcond=None)[0]
    coefficients = free @ solved
    error = float(np.sqrt(np.mean(((terms @ coefficients - moment) * weight) ** 2)))
    return Springs(bands, coefficients[:number], coefficients[number:] / reach**2, error, reach)


#: Hooks that act on the picture only: no physics of the cable.
_OF_CAMERA = ("camera_time", "camera_points")
#: Effects that have an element of their own in the exported model.
_OWN_ELEMENT = (AirDrag, GripAngle, StressRelaxation)
#: Why hooks cannot be expressed, in the order of the checks.  The other hooks, such as masses, rest
#: shape and length, become numbers of the chain, for a user's own effects too.
_REASONS = {
    "moment": "a bending moment with memory; a MuJoCo spring has none of this law",
    "force": "a force of the surroundings that is no part of MuJoCo's fluid model",
    "point_mass": "a mass between clamp and tip; the exported links have one mass per length",
    "clamp": "how the gripper moves; move the gripper of the exported model so",
    "camera_time": "belongs to the camera, not to the cable",
    "camera_points": "belongs to the camera, not to the cable",
}


#: Number of places at which an inertia is evaluated.
_PLACES = 101


@dataclass(frozen=True)
class OmittedEffect:
    """An effect that the export omits, and why."""

    name: str
    reason: str


def why_not(active: ActiveEffect, model: CableModel) -> str | None:
    """Why a chain of hinges in MuJoCo cannot have this effect of a model; None if it can."""
    effect = active.effect
    if effect in _OWN_ELEMENT:
        return None
    for hook, reason in _REASONS.items():
        if getattr(effect, hook) is not None:
            return reason
    arcs_m = np.linspace(0.0, model.cable.free_length_m, _PLACES)
    along, normal = added_inertia(model, [active], arcs_m)
    if not np.array_equal(along, normal):
        return "inertia that differs along and across the strip; a rigid body's is the same"
    return None


def expressible(model: CableModel) -> tuple[CableModel, tuple[OmittedEffect, ...]]:
    """The model with the effects that MuJoCo can express, and the others with their reasons."""
    reasons = [(active, why_not(active, model)) for active in model.effects]
    expressed = tuple(active for active, reason in reasons if reason is None)
    omitted = tuple(
        OmittedEffect(a.effect.name, reason) for a, reason in reasons if reason is not None
    )
    return replace(model, effects=expressed), omitted


def physical(model: CableModel) -> CableModel:
    """The model without the effects that act only on the camera image."""
    physical = [a for a in model.effects if all(getattr(a.effect, h) is None for h in _OF_CAMERA)]
    return replace(model, effects=tuple(physical))


def value(model: CableModel, effect: type[Effect], name: str) -> float:
    """Value of an effect's parameter in the model; 0 if the model does not have the effect."""
    return next((a.named[name] for a in model.effects if a.effect is effect), 0.0)


@dataclass(frozen=True, eq=False)
class Chain:
    """Links from the clamp to the tip; link 0 is half a link, held; so is the last, free.

    cable              its datasheet; a connector is fixed to the last link
    link_m             (n + 1,) lengths
    mass_kg            (n + 1,) that resists motion, without point mass and connector
    weight_kg          (n + 1,) that has weight
    tip_kg             point mass at the tip
    curvature_length_m (n,) arc length that each hinge stands for: bend over curvature
    rigidity_n_m2      (n,) EI at the hinges
    rest_rad           (n,) bends free of load
    damping_n_m_s      (n,) of the hinges, per rad
    grip               stiffness, N·m/rad, and damping, N·m·s/rad, of a compliant grip, or None
    grip_angle_rad     angle of the cable between the jaws
    air_kg_per_m3      density of a fluid with drag coefficient 1 that drags as the air does
    springs            the law of bending
    relaxation         share of EI, and time, s, of a Maxwell branch in parallel to a hinge, or None
    """

    cable: Cable
    gravity_m_per_s2: tuple[float, float]
    link_m: FloatArray
    mass_kg: FloatArray
    weight_kg: FloatArray
    tip_kg: float
    curvature_length_m: FloatArray
    rigidity_n_m2: FloatArray
    rest_rad: FloatArray
    damping_n_m_s: FloatArray
    grip: tuple[float, float] | None
    grip_angle_rad: float
    air_kg_per_m3: float
    springs: Springs
    relaxation: tuple[float, float] | None = None

    @property
    def links(self) -> int:
        """Number of hinges that bend."""
        return len(self.rigidity_n_m2)


def chain_of(model: CableModel, links: int) -> Chain:
    """The chain of a model whose effects a chain can express.

    raises  ValueError: fewer than 4 links; effects shorten the cable to less than a tenth
    """
    (block,) = assemble([model], links, 0.0)
    field = block.state.reshape(links + 1, at.FIELDS, at.LANES)[:, :, 0]
    length, per_length = field[:, at.LENGTH], field[1:, at.PER_LENGTH]
    weight, mass = field[:, at.WEIGHT].copy(), field[:, at.MASS].copy()
    rigid = model.cable.connector.mass_kg if model.cable.connector else 0.0
    tip = float(weight[-1] - model.cable.line_density_kg_per_m * length[-1]) - rigid
    weight[-1] -= tip + rigid
    mass[-1] -= tip + rigid
    share = value(model, StressRelaxation, "fraction")
    compliant = field[0, at.FREE] > 0.0
    return Chain(
        model.cable,
        model.gravity_m_per_s2,
        length.copy(),
        mass,
        weight,
        tip if tip > 1e-9 * (weight.sum() + rigid) else 0.0,  # rounding of the difference
        1.0 / per_length,
        field[1:, at.RIGIDITY].copy(),
        field[1:, at.REST] / per_length,
        field[1:, at.VISCOSITY] * per_length,
        (float(field[0, at.SPRING]), float(field[0, at.VISCOSITY])) if compliant else None,
        value(model, GripAngle, "angle_rad"),
        AIR_DENSITY_KG_PER_M3 * value(model, AirDrag, "drag_coefficient"),
        springs_for(model.exponent, float(length.sum())),
        (share, value(model, StressRelaxation, "time_s")) if share else None,
    )


def resting_bends(model: CableModel, links: int, clamp_rad: float) -> FloatArray:
    """(links + 1,) bends of the grip and of the hinges at rest under a clamp angle, rad.

    raises  statics.UnsettledError
    """
    (block,) = assemble([model], links, 0.0)
    base = at.vectors(1, at.BASE_FIELDS)
    base[0, at.BASE_ANGLE] = clamp_rad + value(model, GripAngle, "angle_rad")
    settle(block, base.ravel())
    bends = block.state.reshape(links + 1, at.FIELDS, at.LANES)[:, at.BEND, 0].copy()
    return np.asarray(bends)
