"""A cable's model read from MuJoCo's XML: a chain of hinges with springs, from any program."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from xml.parsers import expat

import numpy as np

from cell.cable.arrays import FloatArray
from cell.exchange.mjcf import CURVATURE_LENGTH, mujoco_library, without_log
from cell.files.input_error import InputError
from cell.files.text_file import read_text


@dataclass(frozen=True, eq=False)
class Spring:
    """Spring of one hinge: moment a D + b D² + c D³, N·m, of the angle D beyond a dead band, rad.

    low_rad, high_rad  ends of the dead band, from the bend free of load
    """

    low_rad: float
    high_rad: float
    coefficients: tuple[float, float, float]

    def __call__(self, angle_rad: FloatArray) -> FloatArray:
        """Moment that turns the hinge back, N·m, at bends from that free of load, rad."""
        d = np.where(
            angle_rad > self.high_rad,
            angle_rad - self.high_rad,
            np.minimum(angle_rad - self.low_rad, 0.0),
        )
        a, b, c = self.coefficients
        return np.asarray(d * (a + d * (b + d * c)))


@dataclass(frozen=True, eq=False)
class HingeChain:
    """A chain of n hinges as read from a file.  SI units; arc lengths from the clamp.

    length_m            of the cable
    arc_length_m        (n,) of the hinges
    curvature_length_m  (n,) bend over curvature
    springs             of every hinge
    rest_rad            (n,) bends free of load
    damping_n_m_s       (n,)
    density_kg_per_m    of the mass with weight
    lines               (n,) lines of the hinges in the file
    notes               on content of the file that is not read
    """

    length_m: float
    arc_length_m: FloatArray
    curvature_length_m: FloatArray
    springs: tuple[tuple[Spring, ...], ...]
    rest_rad: FloatArray
    damping_n_m_s: FloatArray
    density_kg_per_m: float
    width_m: float
    thickness_m: float
    gravity_m_per_s2: float
    lines: tuple[int, ...]
    notes: tuple[str, ...]


#: Elements that are joints.
_JOINTS = ("joint", "freejoint")


def element_lines(text: str) -> dict[tuple[str, str], int]:
    """Lines, from 1, by element and name ('' without one); joints of bodies also by number.

    A joint's number is that in document order, as MuJoCo numbers them: ('#joint', '0').  Elements
    after a mistake have no lines.
    """
    lines: dict[tuple[str, str], int] = {}
    open_elements: list[str] = []
    count = 0

    def start(element: str, attributes: dict[str, str]) -> None:
        nonlocal count
        line = parser.CurrentLineNumber
        inside_body = bool(open_elements) and open_elements[-1] in ("body", "worldbody")
        if element not in _JOINTS or inside_body:
            lines.setdefault((element, attributes.get("name", "")), line)
        if element in _JOINTS and inside_body:
            lines[("#joint", str(count))] = line
            count += 1
        open_elements.append(element)

    def end(element: str) -> None:
        open_elements.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    with suppress(expat.ExpatError):
        parser.Parse(text, True)
    return lines


def line_in(message: str) -> int:
    """The line in a message of MuJoCo's; 1 without one."""
    named = re.search(r"\bline(?: number)?[ :=]+(\d+)", message, re.IGNORECASE)
    return int(named[1]) if named else 1


#: Size limit of a file, bytes: our own chain of 1000 links has less.
MAX_BYTES = 20_000_000
#: Fewest hinges from which EI(s) is read: a cubic has four coefficients.
FEWEST = 4
#: Tolerance for straightness, share of the length, and for uniformity, share of the density.
STRAIGHT, EVEN = 0.01, 0.02
#: Least distance of hinges, share of the length; closer ones coincide.
NEAR = 1e-6
#: Upper limit of a plausible damping of a hinge.
MOST_DAMPING_N_M_S = 1e6


def read_chain(path: Path) -> HingeChain:
    """The chain in a file.

    raises  NoMujocoError; InputError: no MJCF, or no chain that may be a cable
    """
    text = read_text(path, MAX_BYTES)
    mujoco = mujoco_library()
    try:
        with without_log():
            model = mujoco.MjModel.from_xml_path(str(path))
            data = mujoco.MjData(model)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        message = f"MuJoCo cannot read it: {reason}; give a chain of hinges with springs, as "
        message += "`cell export` writes it"
        raise InputError.at(path, message, line=line_in(reason)) from error
    return _MjcfReader(path, model, data, element_lines(text)).chain()


class _MjcfReader:
    """One file, compiled by MuJoCo at its initial configuration."""

    def __init__(
        self, path: Path, model: Any, data: Any, lines: dict[tuple[str, str], int]
    ) -> None:
        self.mujoco = mujoco_library()
        self.path, self.model, self.data, self.lines = path, model, data, lines
        self.data.qpos[:] = model.qpos0
        self.mujoco.mj_kinematics(model, self.data)
        self.notes: list[str] = []

    def chain(self) -> HingeChain:
        """The chain, checked."""
        m = self.model
        joints = self._without_grip(self._hinges())
        axis = self.data.xaxis[joints[0]]
        for j in joints:
            if abs(float(self.data.xaxis[j] @ axis)) < 1.0 - 1e-6:
                self._refuse(j, "turns about another axis than the first", "make axes parallel")
        arc, length, along = self._line(joints)
        gravity = np.array(m.opt.gravity)
        in_plane = float(np.linalg.norm(gravity - (gravity @ axis) * axis))
        if in_plane == 0.0:
            message = "option/gravity has nothing in the cable's plane; a cable needs its weight"
            raise InputError.at(self.path, f"{message}: set it", line=self._line_of("option", ""))
        width, thickness = self._section(joints, axis, along)
        dofs = m.jnt_dofadr[joints]
        if np.any(m.dof_dampingpoly[dofs]):
            self.notes.append("damping beyond the linear is not read")
        damping = np.array(m.dof_damping[dofs])
        for j, one in zip(joints, damping, strict=True):
            if not 0.0 <= one < MOST_DAMPING_N_M_S:
                self._refuse(
                    j,
                    f"has damping {one:g} N·m·s/rad, must be 0 … {MOST_DAMPING_N_M_S:g}",
                    "mind the units",
                )
        self._refuse_other_forces(joints)
        self._note_unread_elements(joints)
        return HingeChain(
            length,
            arc,
            self._curvature_length(len(joints), arc, length),
            tuple(self._springs(j) for j in joints),
            np.array(m.qpos_spring[m.jnt_qposadr[joints]] - m.qpos0[m.jnt_qposadr[joints]]),
            damping,
            self._density(joints, arc, length),
            width,
            thickness,
            in_plane,
            tuple(self._joint_line(j) for j in joints),
            tuple(self.notes),
        )

    def _hinges(self) -> list[int]:
        """The joints with springs, from the clamp out, each on the body of its predecessor."""
        m = self.model
        sprung = (m.jnt_stiffness != 0.0) | np.any(m.jnt_stiffnesspoly != 0.0, axis=1)
        joints = [int(j) for j in np.flatnonzero(sprung)]
        if len(joints) < FEWEST:
            hinges = m.jnt_type == self.mujoco.mjtJoint.mjJNT_HINGE
            without = [int(j) for j in np.flatnonzero(hinges & ~sprung)]
            raise InputError.at(
                self.path,
                f"has {len(joints)} joints with stiffness; a chain needs at least {FEWEST} hinges "
                "with a spring each: export a cable, or give the joints `stiffness`",
                line=self._joint_line(without[0]) if without else 1,
            )
        before = -1
        for j in joints:
            if m.jnt_type[j] != self.mujoco.mjtJoint.mjJNT_HINGE:
                self._refuse(j, "is no hinge", "make it one: a cable bends in a plane")
            if not m.jnt_stiffness[j] > 0.0:
                self._refuse(j, f"has stiffness {m.jnt_stiffness[j]:g}", "give it more than 0")
            body = int(m.jnt_bodyid[j])
            if m.body_jntnum[body] != 1:
                self._refuse(j, "shares its body with another joint", "give it a link of its own")
            if before >= 0 and not self._hangs_on(body, before):
                self._refuse(
                    j, "does not hang on the hinge before it", "leave one chain without branches"
                )
            before = body
        return joints

    def _hangs_on(self, body: int, ancestor: int) -> bool:
        """Whether a body is a child of `ancestor`, with only fixed bodies between them."""
        parent = int(self.model.body_parentid[body])
        while parent not in (0, ancestor) and self.model.body_jntnum[parent] == 0:
            parent = int(self.model.body_parentid[parent])
        return parent == ancestor

    def _without_grip(self, joints: list[int]) -> list[int]:
        """The hinges that bend, without that of a compliant grip, which precedes them."""
        stated = self._stated_length()
        if stated is None or len(stated) != len(joints) - 1 or len(stated) < FEWEST:
            return joints
        self.notes.append("the compliance of the grip is not read")
        return joints[1:]

    def _line(self, joints: Sequence[int]) -> tuple[FloatArray, float, FloatArray]:
        """Arc lengths of the hinges, the cable's length, and the direction from the clamp out."""
        m, data = self.model, self.data
        anchors = np.array(data.xanchor[joints])
        last = int(m.jnt_bodyid[joints[-1]])
        centre = data.xpos[last] + data.xmat[last].reshape(3, 3) @ m.body_ipos[last]
        tip = anchors[-1] + 2.0 * (centre - anchors[-1])
        clamp = self._clamp(joints, anchors)
        points = np.vstack([clamp, anchors, tip])
        along = tip - clamp
        length = float(np.linalg.norm(along))
        if not length > 0.0:
            self._refuse(joints[-1], "has no link beyond it", "give its body a mass at a distance")
        along /= length
        arc = (points - clamp) @ along
        off = np.linalg.norm(points - clamp - arc[:, None] * along, axis=1)
        after = np.diff(arc)[1:]  # of every hinge: to the next, or to the tip
        for j, offset, step in zip(joints, off[1:], after, strict=False):
            if not step > NEAR * length:
                self._refuse(j, "is no nearer to the clamp than what follows", "give links lengths")
            if offset > STRAIGHT * length:
                self._refuse(
                    j,
                    f"is {offset * 1e3:.3g} mm off the line from the clamp to the tip",
                    "draw the chain straight; bends free of load are `springref`",
                )
        return np.asarray(arc[1:-1]), length, along

    def _clamp(self, joints: Sequence[int], anchors: FloatArray) -> FloatArray:
        """Where the cable is held: the origin of the body that the first hinge hangs on.

        A chain that begins with a hinge is held there.
        """
        parent = int(self.model.body_parentid[self.model.jnt_bodyid[joints[0]]])
        place = np.array(self.data.xpos[parent])
        spacing = float(np.linalg.norm(anchors[1] - anchors[0]))
        gap = float(np.linalg.norm(anchors[0] - place))
        # half a link is held; anything longer is the gripper or the world
        return place if parent and gap <= 0.75 * spacing else anchors[0]

    def _stated_length(self) -> FloatArray | None:
        """Arc lengths that the file states for its hinges; None = none."""
        m, kind = self.model, self.mujoco.mjtObj.mjOBJ_NUMERIC
        i = self.mujoco.mj_name2id(m, kind, CURVATURE_LENGTH)
        if i < 0:
            return None
        start, size = int(m.numeric_adr[i]), int(m.numeric_size[i])
        return np.array(m.numeric_data[start : start + size])

    def _curvature_length(self, n: int, arc: FloatArray, length: float) -> FloatArray:
        """Stated arc length, else from half-way to the previous hinge to half-way to the next.

        The first and the last represent equal lengths on both sides: a hinge at the clamp with the
        same spring as the others is of the same cable.
        """
        stated = self._stated_length()
        if stated is None:
            middle = 0.5 * (arc[1:] + arc[:-1])
            first, last = 2.0 * arc[0] - middle[0], min(length, 2.0 * arc[-1] - middle[-1])
            ends = np.concatenate([[first], middle, [last]])
            return np.asarray(np.diff(ends))
        if len(stated) != n or not np.all(stated > 0.0):
            message = (
                f"{CURVATURE_LENGTH} has {len(stated)} numbers, the least {stated.min():g}, for "
                f"{n} hinges; give one above 0 for each, or leave it out"
            )
            line = self._line_of("numeric", CURVATURE_LENGTH)
            raise InputError.at(self.path, message, line=line)
        return stated

    def _springs(self, joint: int) -> tuple[Spring, ...]:
        """All springs of one hinge, its own and those of tendons that have only this joint."""
        m = self.model
        rest = float(m.qpos_spring[m.jnt_qposadr[joint]])
        own = (float(m.jnt_stiffness[joint]), *map(float, m.jnt_stiffnesspoly[joint]))
        springs = [Spring(0.0, 0.0, own)]  # type: ignore[arg-type]
        for t in range(m.ntendon):
            start, wraps = int(m.tendon_adr[t]), int(m.tendon_num[t])
            if wraps != 1 or int(m.wrap_objid[start]) != joint:
                continue
            if m.wrap_type[start] != self.mujoco.mjtWrap.mjWRAP_JOINT or m.wrap_prm[start] != 1.0:
                continue
            low, high = (float(end) - rest for end in m.tendon_lengthspring[t])
            stiff = (float(m.tendon_stiffness[t]), *map(float, m.tendon_stiffnesspoly[t]))
            springs.append(Spring(low, high, stiff))  # type: ignore[arg-type]
        return tuple(springs)

    def _density(self, joints: Sequence[int], arc: FloatArray, length: float) -> float:
        """Mass with weight per metre, of all links alike."""
        m = self.model
        bodies = m.jnt_bodyid[joints]
        mass = np.array(m.body_mass[bodies] * (1.0 - m.body_gravcomp[bodies]))
        density = mass / np.diff(np.append(arc, length))
        middle = float(np.median(density))
        for j, link in zip(joints, density, strict=True):
            if not (link > 0.0 and abs(link - middle) <= EVEN * middle):
                self._refuse(
                    j,
                    f"moves a link of {link:.4g} kg/m, the chain has {middle:.4g} kg/m",
                    "give all links one mass per length; a mass at the tip is a body of its own",
                )
        if np.any(m.body_gravcomp[bodies]):
            self.notes.append("mass without weight (gravcomp) is not read")
        return float(mass.sum() / (length - arc[0]))

    def _section(
        self, joints: Sequence[int], axis: FloatArray, along: FloatArray
    ) -> tuple[float, float]:
        """Width, along the hinges' axis, and thickness: of the first link that has a shape.

        A round section becomes a strip of the same width and area.
        """
        m, kinds = self.model, self.mujoco.mjtGeom
        bodies = m.jnt_bodyid[joints]
        round_kinds = (int(kinds.mjGEOM_CAPSULE), int(kinds.mjGEOM_CYLINDER))
        shapes = np.isin(m.geom_type, (int(kinds.mjGEOM_BOX), *round_kinds))
        visible = np.flatnonzero(shapes & np.isin(m.geom_bodyid, bodies))
        if not visible.size:
            self._refuse(
                joints[0],
                "moves a link without a box, capsule or cylinder",
                "add one to say how wide and thick the cable is",
            )
        g = int(visible[0])
        size, turn = m.geom_size[g], self.data.geom_xmat[g].reshape(3, 3)
        if m.geom_type[g] in round_kinds:
            return 2.0 * float(size[0]), 0.5 * np.pi * float(size[0])
        across = np.cross(axis, along)
        return (
            float(2.0 * np.abs(axis @ turn) @ size),
            float(2.0 * np.abs(across @ turn) @ size),
        )

    def _refuse_other_forces(self, joints: Sequence[int]) -> None:
        """Raise InputError: something holds or drives the chain besides its springs and weight."""
        m, kinds = self.model, self.mujoco.mjtObj
        bodies = {int(b) for b in m.jnt_bodyid[joints]}
        for e in range(m.neq):
            kind, ends = int(m.eq_objtype[e]), {int(m.eq_obj1id[e]), int(m.eq_obj2id[e])}
            if kind == int(kinds.mjOBJ_SITE):
                ends = {int(m.site_bodyid[s]) for s in ends if s >= 0}
            of_chain = bodies if kind in (int(kinds.mjOBJ_BODY), int(kinds.mjOBJ_SITE)) else joints
            if ends & set(of_chain):
                self._refuse_element(
                    "equality", kinds.mjOBJ_EQUALITY, e,
                    "holds the cable a second time: only one with a free tip can be modelled",
                )  # fmt: skip
        for a in range(m.nu):
            if self._driven(a) & set(joints):
                self._refuse_element("actuator", kinds.mjOBJ_ACTUATOR, a, "drives the cable")
        for j in joints:
            if m.body_plugin[m.jnt_bodyid[j]] >= 0:
                self._refuse(
                    j, "moves a link with a plugin", "give the hinge its stiffness instead"
                )
        if m.nflex:
            message = "is no chain of hinges"
            self._refuse_element("flex", kinds.mjOBJ_FLEX, 0, message)

    def _driven(self, actuator: int) -> set[int]:
        """Joints that an actuator drives, by itself, by a tendon, or at a site or body."""
        m, kinds = self.model, self.mujoco.mjtTrn
        kind, end = int(m.actuator_trntype[actuator]), int(m.actuator_trnid[actuator, 0])
        if kind in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            return {end}
        if kind == int(kinds.mjTRN_TENDON):
            start = int(m.tendon_adr[end])
            return {int(j) for j in m.wrap_objid[start : start + int(m.tendon_num[end])]}
        body = end if kind == int(kinds.mjTRN_BODY) else int(m.site_bodyid[end])
        return {j for j in range(m.njnt) if int(m.jnt_bodyid[j]) == body}

    def _refuse_element(self, element: str, kind: Any, number: int, reason: str) -> NoReturn:
        name = self.mujoco.mj_id2name(self.model, kind, number) or f"number {number}"
        line = self._line_of(element, "")
        raise InputError.at(self.path, f"{element} {name!r} {reason}; remove it", line=line)

    def _note_unread_elements(self, joints: Sequence[int]) -> None:
        """Notes on content of the file besides EI, N, viscosity and the datasheet."""
        m, last = self.model, int(self.model.jnt_bodyid[joints[-1]])
        dofs, gravity = m.jnt_dofadr[joints], self.mujoco.mjtDisableBit.mjDSBL_GRAVITY
        armature = float(m.dof_armature[dofs].max())
        range_deg = float(np.degrees(np.abs(m.jnt_range[joints]).max()))
        links = np.isin(m.geom_bodyid, m.jnt_bodyid[joints])
        touches = m.geom_contype != 0
        tendons = (m.tendon_damping, m.tendon_frictionloss, m.tendon_limited)
        self.notes += [
            note
            for there, note in (
                (np.any(m.dof_armature[dofs]),
                 f"inertia of the joints (armature, up to {armature:.3g} kg·m²) is not read"),
                (np.any(m.jnt_limited[joints]),
                 f"limits of the joints (range, up to {range_deg:.3g}°) are not read"),
                (m.neq, "constraints of other bodies (equality) are not read"),
                (m.nplugin, "plugins are not read"),
                (m.opt.disableflags & int(gravity),
                 "option/flag gravity is off: the cable is read with its weight"),
                (np.any(touches & ~links) and np.any(touches & links),
                 "contact with other bodies is not read"),
                (any(map(np.any, tendons)),
                 "damping, friction and limits of tendons are not read"),
                (m.body_subtreemass[last] > m.body_mass[last],
                 "bodies beyond the chain, as a mass at the tip, are not read"),
                (m.opt.density or m.opt.viscosity or np.any(m.opt.wind),
                 "air (option density, viscosity, wind) is not read"),
                (np.any(m.tendon_num > 1), "springs between several joints are not read"),
                (np.any(m.dof_frictionloss), "dry friction (frictionloss) is not read"),
                (np.any(m.jnt_springyield) or np.any(m.tendon_springyield),
                 "springs that yield (springyield) are read as elastic"),
            )
            if there
        ]  # fmt: skip

    def _refuse(self, joint: int, reason: str, remedy: str) -> NoReturn:
        line = self._joint_line(joint)
        name = self._name(joint)
        raise InputError.at(self.path, f"joint {name!r} {reason}; {remedy}", line=line)

    def _name(self, joint: int) -> str:
        kind = self.mujoco.mjtObj.mjOBJ_JOINT
        return self.mujoco.mj_id2name(self.model, kind, joint) or f"number {joint}"

    def _joint_line(self, joint: int) -> int:
        """Line of a joint: by its name, or as the joint of that number in the file."""
        name = self._name(joint)
        numbered = self.lines.get(("#joint", str(joint)), 1)
        return self.lines.get(("joint", name), numbered)

    def _line_of(self, element: str, name: str) -> int:
        return self.lines.get((element, name), 1)
