"""Measuring motions: suggested strokes, and files (`cell-motion/1`) of motions.

A file is checked against the limits of the cell that is to execute it.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from cell.cable.geometry import Motion
from cell.files.atomic import write_atomic
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, read_yaml, validate, yaml_text
from cell.plan.measuring import Measuring, Move, least_duration_s, measuring_path, quintic
from cell.settings import Settings
from cell.settings.section import Angle, Finite, Section
from cell.settings.surroundings import Surroundings
from cell.settings.translate import arm_limits_of, pose_from_home
from drivers.interfaces import Pose

FORMAT = "cell-motion/1"
STILL_S, HOLD_S, RATE_HZ = 0.2, 1.0, 500.0
ATTITUDES_RAD = tuple(np.radians([-90.0, -60.0, -30.0, -15.0, 0.0, 15.0, 30.0, 60.0, 90.0]))
STROKES_M = (
    (0.0, -0.05), (0.0, -0.08), (0.0, 0.05), (0.0, 0.08),
    (-0.05, 0.0), (-0.08, 0.0), (0.05, 0.0), (-0.05, -0.05),
)  # fmt: skip


SLOWNESS = (1.0, 1.6)
#: Step, rad, of the clamp angle between home and stroke at which the resting cable is checked.
TURN_RAD = np.radians(15.0)


@dataclass(frozen=True)
class Stroke:
    """A straight stroke by (dx, dy) in `duration_s` from rest at (x, y), clamp at `angle_rad`."""

    angle_rad: float
    dx_m: float
    dy_m: float
    duration_s: float
    x_m: float = 0.0
    y_m: float = 0.0

    def describe(self) -> str:
        """Text of the stroke."""
        return (
            f"clamp at {np.degrees(self.angle_rad):.0f}°, from ({self.x_m * 1e3:.0f}, "
            f"{self.y_m * 1e3:.0f}) by ({self.dx_m * 1e3:.0f}, {self.dy_m * 1e3:.0f}) mm in "
            f"{self.duration_s:.2f} s"
        )

    def motion(self) -> Motion:
        """The gripper's pose against time: still, a fifth-order polynomial, held."""
        t_s = np.arange(0.0, STILL_S + self.duration_s + HOLD_S, 1.0 / RATE_HZ)
        u = np.clip((t_s - STILL_S) / self.duration_s, 0.0, 1.0)
        s = quintic(u)
        x, y = self.x_m + self.dx_m * s, self.y_m + self.dy_m * s
        return Motion(t_s, x, y, np.full_like(t_s, self.angle_rad))


def strokes(surroundings: Surroundings) -> list[Stroke]:
    """Strokes from home, as fast as the limits allow and slower, the clamp within its limits."""
    result = []
    for angle, (dx, dy), slow in itertools.product(ATTITUDES_RAD, STROKES_M, SLOWNESS):
        if not surroundings.allows(float(angle)):
            continue
        least_s = least_duration_s(
            float(np.hypot(dx, dy)),
            (
                surroundings.velocity_m_per_s,
                surroundings.acceleration_m_per_s2,
                surroundings.jerk_m_per_s3,
            ),
        )
        duration_s = round(slow * least_s + 0.005, 3)
        result.append(Stroke(float(angle), dx, dy, duration_s, *surroundings.home[:2]))
    return result


@dataclass(frozen=True)
class Option:
    """A motion within all limits, and how well it distinguishes the candidates.

    separation  χ² between the likeliest candidate and the one hardest to distinguish from it
    hardest     name of that one
    power       probability that the motion decides against every other candidate, if noise and
                candidates are as assumed
    """

    motion: Stroke
    separation: float
    hardest: str
    power: float


@dataclass(frozen=True)
class Suggestion:
    """Motions, the most informative first, and the candidates that they distinguish.

    refused    number of motions refused, by limit
    separated  whether the study's own trials already distinguish the candidates
    """

    candidates: tuple[str, ...]
    options: tuple[Option, ...]
    surroundings: Surroundings
    refused: Mapping[str, int]
    separated: bool = False

    def separated_text(self) -> str:
        """Text for candidates that the study's own trials distinguish."""
        first, *rivals = self.candidates
        return (
            f"The present trials already separate {first} from {', '.join(rivals)}: no further "
            "recording is needed"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-suggestion/1",
            "candidates": list(self.candidates),
            "separated": self.separated,
            "options": [
                {
                    **vars(o.motion),
                    "separation": o.separation,
                    "hardest": o.hardest,
                    "power": o.power,
                }
                for o in self.options
            ],
            "refused": dict(self.refused),
        }


def write_motion(suggestion: Suggestion, path: Path) -> None:
    """Write the best motion as YAML for `cell run --motion`: places from the cell's home."""
    best = suggestion.options[0].motion
    home_x, home_y, _ = suggestion.surroundings.home
    x_m, y_m = best.x_m - home_x, best.y_m - home_y
    first, *rivals = suggestion.candidates
    content = {
        "format": FORMAT,
        "purpose": f"tell {first} from {', '.join(rivals)}",
        "start": {"x_m": round(x_m, 6), "y_m": round(y_m, 6), "angle_rad": best.angle_rad},
        "still_s": STILL_S,
        "moves": [
            {
                "x_m": round(x_m + best.dx_m, 6),
                "y_m": round(y_m + best.dy_m, 6),
                "angle_rad": best.angle_rad,
                "duration_s": best.duration_s,
            }
        ],
        "hold_s": HOLD_S,
    }
    write_atomic(path, yaml_text(content))


#: Tolerance of a pose's limits, m or rad: numbers in a file are rounded to micrometres.
ROUNDING = 1e-6

Duration = Annotated[float, Field(gt=0.0, le=60.0, allow_inf_nan=False)]


class MotionPose(Section):
    """Pose of the gripper: x and y from the cell's home; the clamp angle itself, 0 = level."""

    x_m: Finite
    y_m: Finite
    angle_rad: Angle

    @property
    def place(self) -> tuple[float, float, float]:
        """x, y, clamp angle."""
        return self.x_m, self.y_m, self.angle_rad


class MotionMove(MotionPose):
    """Straight to a pose, from rest to rest."""

    duration_s: Duration


class MotionFile(Section):
    """A measuring motion as a file: `cell suggest` writes it, `cell run --motion` executes it."""

    format: Literal["cell-motion/1"]
    purpose: str = ""
    start: MotionPose
    still_s: Annotated[float, Field(ge=0.05, le=60.0)]
    """Filmed at rest before the first move; shows the noise."""
    moves: Annotated[list[MotionMove], Field(min_length=1, max_length=100)]
    hold_s: Duration
    """Filmed after the last move."""


def load_motion(path: Path, settings: Settings) -> Measuring:
    """The motion in a YAML file, for a cell of these settings; named after the file.

    raises  InputError: every mistake, each with file, line, column, key, value, limit, remedy
    """
    document = read_yaml(path)
    motion = validate(document, MotionFile)
    problems = [
        *_name(document),
        *_within_limits(document, motion, settings),
        *_slow_enough(document, motion, settings),
    ]
    if problems:
        raise InputError(problems)
    return Measuring(
        name=path.stem,
        start=pose_from_home(settings, *motion.start.place),
        still_s=motion.still_s,
        moves=tuple(
            Move(pose_from_home(settings, *move.place), move.duration_s) for move in motion.moves
        ),
        hold_s=motion.hold_s,
    )


def hand_motion(path: Path, home: tuple[float, float]) -> tuple[str, Motion]:
    """Name of the motion in a YAML file, and the gripper's pose; no cell's limits are checked.

    home    x and y of the file's origin, m
    raises  InputError: every mistake, each with file, line, column, key, value, limit, remedy
    """
    document = read_yaml(path)
    motion = validate(document, MotionFile)
    if problems := _name(document):
        raise InputError(problems)
    poses = [Pose(home[0] + p.x_m, home[1] + p.y_m, p.angle_rad) for p in (
        motion.start, *motion.moves)]  # fmt: skip
    moves = [Move(pose, m.duration_s) for pose, m in zip(poses[1:], motion.moves, strict=True)]
    move = measuring_path(poses[0], moves, RATE_HZ)
    step_s = 1.0 / RATE_HZ
    before = np.arange(0.0, motion.still_s, step_s)
    after = np.arange(step_s, motion.hold_s, step_s)
    t_s = np.concatenate([before, before[-1] + step_s + move.t_s])
    t_s = np.concatenate([t_s, t_s[-1] + after])
    around = len(before), len(after)
    values = (np.pad(v, around, mode="edge") for v in (move.x_m, move.y_m, move.angle_rad))
    return path.stem, Motion(t_s, *values)


def _name(document: Document) -> list[Problem]:
    stem = document.path.stem
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", stem):
        return []
    message = f"the trial is named after the file, and {stem!r} is no name; rename the file"
    return [document.problem((), message)]


def _within_limits(document: Document, motion: MotionFile, settings: Settings) -> list[Problem]:
    """Problems of poses outside the box; moves are straight, so that their ends are sufficient."""
    problems = []
    keys = [("start",), *(("moves", i) for i in range(len(motion.moves)))]
    for key, stated in zip(keys, [motion.start, *motion.moves], strict=True):
        pose = pose_from_home(settings, *stated.place)
        for axis in ("x_m", "y_m", "angle_rad"):
            value = getattr(pose, axis)
            low, high = getattr(settings.limits, axis)
            if not low - ROUNDING <= value <= high + ROUNDING:
                message = (
                    f"takes the gripper to {axis} = {value:g}, outside limits.{axis} = "
                    f"[{low:g}, {high:g}]; move less or widen the limits"
                )
                problems.append(document.problem((*key, axis), message))
    return problems


def _slow_enough(document: Document, motion: MotionFile, settings: Settings) -> list[Problem]:
    """Problems of moves too short for the cell's limits in the plane, or the guard's of turning."""
    arm = arm_limits_of(settings)
    straight = (arm.max_speed_m_per_s, arm.max_acceleration_m_per_s2, arm.max_jerk_m_per_s3)
    turning = (
        arm.max_angular_speed_rad_per_s,
        arm.max_angular_acceleration_rad_per_s2,
        arm.max_angular_jerk_rad_per_s3,
    )
    problems = []
    pose: MotionPose = motion.start
    for i, move in enumerate(motion.moves):
        distance_m = float(np.hypot(move.x_m - pose.x_m, move.y_m - pose.y_m))
        turn_rad = abs(move.angle_rad - pose.angle_rad)
        least_s = max(least_duration_s(distance_m, straight), least_duration_s(turn_rad, turning))
        if move.duration_s < least_s:
            message = (
                f"{move.duration_s:g} s is too short for {distance_m * 1e3:g} mm and {turn_rad:g} "
                "rad within the cell's limits of speed, acceleration and jerk; give at least "
                f"{np.ceil(least_s * 1e3) / 1e3:g} s"
            )
            problems.append(document.problem(("moves", i, "duration_s"), message))
        pose = move
    return problems
