"""Which effects of a model a chain of hinges can have in MuJoCo, and why the others cannot."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cell.cable.effects.air import AirDrag
from cell.cable.effects.base import ActiveEffect, Effect
from cell.cable.effects.bending import StressRelaxation
from cell.cable.effects.grip import GripAngle
from cell.cable.model import CableModel

#: Hooks that only see the picture: no physics of the cable.
_OF_CAMERA = ("camera_time", "camera_points")
#: Effects that have an element of their own in the exported model.
_OWN_ELEMENT = (AirDrag, GripAngle, StressRelaxation)
#: Why hooks cannot be expressed, in the order in which they are looked at.  The other hooks, as
#: masses, rest shape and length, become numbers of the chain, of a user's own effects too.
_REASONS = {
    "moment": "a bending moment with memory; a MuJoCo spring has none of this law",
    "force": "a force of the surroundings that is no part of MuJoCo's fluid model",
    "clamp": "how the hand moves; move the hand of the exported model so",
    "camera_time": "belongs to the camera, not to the cable",
    "camera_points": "belongs to the camera, not to the cable",
}


@dataclass(frozen=True)
class LeftOut:
    """An effect that the export does not have, and why."""

    name: str
    reason: str


def why_not(active: ActiveEffect) -> str | None:
    """Why a chain of hinges in MuJoCo cannot have this effect; None if it can."""
    effect = active.effect
    if effect in _OWN_ELEMENT:
        return None
    for hook, reason in _REASONS.items():
        if getattr(effect, hook) is not None:
            return reason
    if effect.inertia is not None and active.named.get("along", 1.0) != 1.0:
        return "inertia that differs along and across the strip; a rigid body's is the same"
    return None


def expressible(model: CableModel) -> tuple[CableModel, tuple[LeftOut, ...]]:
    """The model with the effects that MuJoCo can have, and the others with their reasons."""
    reasons = [(active, why_not(active)) for active in model.effects]
    kept = tuple(active for active, reason in reasons if reason is None)
    left = tuple(LeftOut(a.effect.name, reason) for a, reason in reasons if reason is not None)
    return replace(model, effects=kept), left


def unseen(model: CableModel) -> CableModel:
    """The model without the effects that only concern the camera."""
    seen = [a for a in model.effects if all(getattr(a.effect, h) is None for h in _OF_CAMERA)]
    return replace(model, effects=tuple(seen))


def value(model: CableModel, effect: type[Effect], name: str) -> float:
    """A parameter of one of the model's effects; 0 if the model does not have the effect."""
    return next((a.named[name] for a in model.effects if a.effect is effect), 0.0)
