"""A chain as MuJoCo's XML (MJCF): plain elements, no plug-in, no callback.

World x is the cell's x, world z its y; hinges turn about −y.  Source of the elements: MuJoCo 3.8+
XML reference, `joint/stiffness` (polynomial), `tendon/fixed` (dead band), `option/density`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Connector
from cell.exchange.chain import Chain
from drivers.installing import install_extra


class NoMujocoError(ValueError):
    """MuJoCo is not installed.  Scenario: `pip install cable-cell` without the extra `mujoco`."""


def mujoco_library() -> Any:
    """The module `mujoco`, whose springs may be polynomials.

    raises  NoMujocoError: it is not installed, or too old
    """
    try:
        import mujoco
    except ImportError as error:
        raise NoMujocoError(f"MuJoCo is needed for this: {install_extra('mujoco')}") from error
    if not hasattr(mujoco.MjModel, "jnt_stiffnesspoly"):
        raise NoMujocoError(
            f"MuJoCo {mujoco.__version__} has no polynomial springs; a newer one is needed: "
            f"{install_extra('mujoco')} --upgrade"
        )
    return mujoco


@contextmanager
def without_log() -> Iterator[None]:
    """Context in which MuJoCo writes no MUJOCO_LOG.TXT into the working folder."""
    mujoco = mujoco_library()
    former = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(former)


#: Added inertia of the gripper's joints, kg and kg·m²: a cable of a gram then moves it by a
#: billionth of what its motors do, and their control is the gripper's acceleration.
HAND_INERTIA = 1e6
#: Names of the joints, and motors, that move the gripper: m, m, rad.
HAND = ("hand_x", "hand_z", "hand_angle")
#: Name of the entry with the arc length that each hinge represents.
CURVATURE_LENGTH = "cable_curvature_length_m"
#: A link's inertia is a strip's; MuJoCo's fluid reads a box from it, whose ends would be dragged
#: too.  A box this much thinner than the strip has ends that do not count.
_THIN = 1e-3


def mjcf(chain: Chain, step_s: float, rest_rad: FloatArray, notes: Sequence[str]) -> str:
    """The XML of a chain.

    step_s    of the integrator
    rest_rad  (links + 1,) bends at rest under a level gripper, of the grip first
    notes     lines of the comment at its head
    """
    head = "\n".join(f"  {escape(note).replace('--', '- -')}" for note in notes)
    lines = [
        '<mujoco model="cable">',
        f"  <!--\n{head}\n  -->",
        '  <compiler angle="radian" inertiafromgeom="false"/>',
        f'  <option timestep="{step_s:g}" integrator="implicitfast" '
        f'gravity="{_n(chain.gravity_m_per_s2[0])} 0 {_n(chain.gravity_m_per_s2[1])}" '
        f'density="{_n(chain.air_kg_per_m3)}" viscosity="0"/>',
        "  <custom>",
        f'    <numeric name="{CURVATURE_LENGTH}" data="{_ns(chain.curvature_length_m)}"/>',
        "  </custom>",
        "  <worldbody>",
        *_bodies(chain),
        *_dashpots(chain),
        "  </worldbody>",
        *_tendons(chain),
        "  <actuator>",
        *(f'    <motor name="{j}" joint="{j}" gear="{HAND_INERTIA:g}"/>' for j in HAND),
        "  </actuator>",
        "  <keyframe>",
        f'    <key name="rest" qpos="{_ns(resting_qpos(chain, np.zeros(3), rest_rad))}"/>',
        "  </keyframe>",
        "</mujoco>",
    ]
    return "\n".join(lines) + "\n"


def resting_qpos(chain: Chain, hand: FloatArray, bends: FloatArray) -> FloatArray:
    """Coordinates of MuJoCo's model: x, z, m, and angle, rad, of the gripper, then bends, rad.

    A relaxed Maxwell branch has flowed as far as its hinge is bent.
    """
    flow = bends[1:] if chain.relaxation else bends[:0]
    return np.concatenate([hand, bends[0 if chain.grip else 1 :], flow])


def _bodies(chain: Chain) -> Iterator[str]:
    yield '    <body name="hand">'
    for name, kind, axis in zip(HAND, ("slide", "slide", "hinge"), _AXES, strict=True):
        which = f'name="{name}" type="{kind}" axis="{axis}"'
        yield f'      <joint {which} armature="{HAND_INERTIA:g}"/>'
    yield '      <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-12 1e-12 1e-12"/>'
    yield '      <site name="grip"/>'
    half = 0.5 * chain.grip_angle_rad
    turn = f' quat="{_n(np.cos(half))} 0 {_n(-np.sin(half))} 0"' if half else ""
    yield f'      <body name="link_0"{turn}{_weightless(chain, 0)}>'
    if chain.grip:
        spring, damper = chain.grip
        yield f"        {_hinge('grip_hinge', _n(spring), damper, 0.0)}"
    yield from _link(chain, 0, "        ")
    for i in range(1, chain.links + 1):
        pad = " " * (6 + 2 * i)
        start = f'pos="{_n(-chain.link_m[i - 1])} 0 0"{_weightless(chain, i)}'
        yield f'{pad}  <body name="link_{i}" {start}>'
        k = i - 1
        length, rigidity = chain.curvature_length_m[k], chain.rigidity_n_m2[k]
        linear, cubic = _per_angle(chain, 0, rigidity, length)
        stiffness = f"{_n(linear)} 0 {_n(cubic)}" if cubic else _n(linear)
        yield f"{pad}    " + _hinge(
            f"hinge_{i}", stiffness, chain.damping_n_m_s[k], chain.rest_rad[k]
        )
        yield from _link(chain, i, f"{pad}    ")
    end, pad = _n(-chain.link_m[-1]), " " * (8 + 2 * chain.links)
    if chain.tip_kg:
        yield f'{pad}  <body name="tip_mass" pos="{end} 0 0"><inertial pos="0 0 0" mass='
        yield f'{pad}    "{_n(chain.tip_kg)}" diaginertia="{_ns(np.full(3, _POINT))}"/></body>'
    if (rigid := chain.cable.connector) is not None:
        yield from _connector(rigid, chain, f"{pad}  ")
        end = _n(-chain.link_m[-1] - rigid.length_m)
    yield f'{pad}  <site name="tip" pos="{end} 0 0"/>'
    for i in range(chain.links + 1, -1, -1):
        yield " " * (4 + 2 * i) + "</body>"


_AXES = ("1 0 0", "0 0 1", "0 -1 0")
#: Moment of inertia of a point: a hundred times the least that MuJoCo takes, kg·m².
_POINT = 1e-13


def _connector(rigid: Connector, chain: Chain, pad: str) -> Iterator[str]:
    """A body fixed to the last link; its shape, as thick as wide, is for display.

    About its length it has a point's inertia: MuJoCo's fluid then drags it as little as the engine.
    """
    centre, half_m = _n(-0.5 * rigid.length_m), 0.5 * chain.cable.width_m
    inertia = np.array([_POINT, rigid.inertia_kg_m2, rigid.inertia_kg_m2 + _POINT])
    yield f'{pad}<body name="connector" pos="{_n(-chain.link_m[-1])} 0 0">'
    yield f'{pad}  <inertial pos="{centre} 0 0" mass="{_n(rigid.mass_kg)}"'
    yield f'{pad}    diaginertia="{_ns(inertia)}"/>'
    yield f'{pad}  <geom type="box" pos="{centre} 0 0" contype="0" conaffinity="0"'
    yield f'{pad}    size="{_ns((0.5 * rigid.length_m, half_m, half_m))}"/>'
    yield f"{pad}</body>"


def _link(chain: Chain, i: int, pad: str) -> Iterator[str]:
    """Inertia and shape of a link that begins at its body's origin and points along −x."""
    length, mass = float(chain.link_m[i]), float(chain.mass_kg[i])
    across = mass * chain.cable.width_m**2 / 12.0
    about = mass * length**2 / 12.0
    thin = mass * (_THIN * chain.cable.thickness_m) ** 2 / 12.0
    inertia = np.array([across + thin, about + thin, across + about])
    yield (
        f'{pad}<inertial pos="{_n(-length / 2)} 0 0" mass="{_n(mass)}" '
        f'diaginertia="{_ns(inertia)}"/>'
    )
    size = (length / 2, chain.cable.width_m / 2, chain.cable.thickness_m / 2)
    yield (
        f'{pad}<geom type="box" pos="{_n(-length / 2)} 0 0" size="{_ns(size)}" '
        'contype="0" conaffinity="0"/>'
    )


def _weightless(chain: Chain, i: int) -> str:
    """The share of a link's mass that has no weight: air that it carries along."""
    share = 1.0 - float(chain.weight_kg[i] / chain.mass_kg[i])
    return f' gravcomp="{_n(share)}"' if abs(share) > 1e-12 else ""


def _hinge(name: str, stiffness: str, damping: float, rest_rad: float) -> str:
    return (
        f'<joint name="{name}" type="hinge" axis="0 -1 0" stiffness="{stiffness}" '
        f'damping="{_n(damping)}" springref="{_n(rest_rad)}"/>'
    )


def _per_angle(chain: Chain, spring: int, rigidity: float, length_m: float) -> tuple[float, float]:
    """Coefficients of a hinge's spring, N·m/rad and N·m/rad³."""
    springs = chain.springs
    return (
        rigidity * float(springs.linear[spring]) / length_m,
        rigidity * float(springs.cubic_m2[spring]) / length_m**3,
    )


def _dashpots(chain: Chain) -> Iterator[str]:
    """Auxiliary joints for the flow of the Maxwell branches: damped, without inertia."""
    if chain.relaxation is None:
        return
    for k in range(chain.links):
        stiffness = chain.relaxation[0] * chain.rigidity_n_m2[k] / chain.curvature_length_m[k]
        yield f'    <body name="flow_{k + 1}"><joint name="flow_{k + 1}" type="hinge" axis='
        yield f'      "0 -1 0" damping="{_n(stiffness * chain.relaxation[1])}"/>'
        yield f'      <inertial pos="0 0 0" mass="1e-9" diaginertia="{_ns(np.full(3, _POINT))}"/>'
        yield "    </body>"


def _tendons(chain: Chain) -> Iterator[str]:
    """Springs beyond a dead band, and of Maxwell branches; a tendon's length is an angle."""
    bands = chain.springs.dead_band_1_per_m
    if len(bands) == 1 and chain.relaxation is None:
        return
    yield "  <tendon>"
    for k in range(chain.links):
        length, rest = chain.curvature_length_m[k], chain.rest_rad[k]
        own = f'<joint joint="hinge_{k + 1}" coef="1"/>'
        for b in range(1, len(bands)):
            linear, cubic = _per_angle(chain, b, chain.rigidity_n_m2[k], length)
            band = bands[b] * length
            yield (
                f'    <fixed name="spring_{k + 1}_{b}" stiffness="{_n(linear)} 0 {_n(cubic)}" '
                f'springlength="{_n(rest - band)} {_n(rest + band)}">{own}</fixed>'
            )
        if chain.relaxation is not None:
            stiffness = chain.relaxation[0] * chain.rigidity_n_m2[k] / length
            yield (
                f'    <fixed name="maxwell_{k + 1}" stiffness="{_n(stiffness)}" '
                f'springlength="0 0">{own}<joint joint="flow_{k + 1}" coef="-1"/></fixed>'
            )
    yield "  </tendon>"


def _n(value: float) -> str:
    """A number with all its significant digits."""
    return repr(float(value))


def _ns(values: Sequence[float] | FloatArray) -> str:
    return " ".join(_n(v) for v in values)
