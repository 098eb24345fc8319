"""A turning clamp whose orientation in space a file gives, in any convention and any plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cell.study.imports.capture import Sure
from cell.study.imports.gripper_section import AngleSection, GripperSection, gripper_complaints
from cell.study.imports.places import clamp_angle_rad
from cell.study.imports.read import read_capture
from cell.study.imports.understand import Files, Stated, Understanding, understand
from tests.cell.study.imports.corpus.swing import LENGTH_M, MARKERS, stroke, swing, times_s
from tests.cell.study.imports.corpus.text import cells, lines, saved

#: Greatest error of an angle, and size of a body whose markers' noise turns it.
LIMIT_RAD, BODY_M = np.radians(0.5), 0.04
#: Noise of 0.2 mm leaves the cable's direction at rest open by 0.16° (one standard deviation).
RATE_HZ = 400.0
#: Names of three angles in the order x, y, z, and the rotations that programs mean by them.
FORMS = {
    "stated": ("Gripper Rotation {}", ("XYZ", "ZYX", "YXZ", "XZY")),
    "unstated": ("Gripper Rotation {}", ("XYZ", "ZYX", "ZXY")),
    "roll": ("Gripper {}", ("ZYX",)),
    "vector": ("Gripper R{}", ("vector",)),
    "quaternion": ("Gripper Q{}", ("quaternion",)),
}


@dataclass(frozen=True, eq=False)
class Variant:
    """A made trial: its file, and its clamp angle (T,)."""

    file: Path
    angle_rad: np.ndarray
    told: str


def made_variant(seed: int, folder: Path) -> Variant:
    """A clamp that goes down and, in two of three, turns; its body is mounted at any angle."""
    rng = np.random.default_rng(seed)
    form = list(FORMS)[seed % len(FORMS)]
    pattern, orders = FORMS[form]
    order = str(rng.choice(orders))
    t_s, noise_m = times_s(RATE_HZ, 1.8), rng.uniform(5e-5, 2e-4)
    turn = 0.0 if seed % 3 == 2 else rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.5)
    angle_rad = rng.uniform(0.0, 0.3) + turn * stroke(t_s)
    m = swing("a", np.outer(stroke(t_s), [0.01, -0.05]), angle_rad, seed, t_s, noise_m)
    # The plane: any azimuth about the vertical, which is y or z.
    azimuth, vertical = rng.uniform(-np.pi, np.pi), int(rng.integers(1, 3))
    up = np.eye(3)[vertical]
    right = np.cos(azimuth) * np.eye(3)[0] + np.sin(azimuth) * np.eye(3)[3 - vertical]
    normal = np.cross(right, up)
    points = np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1)
    spatial = points @ np.array([right, up]) + rng.uniform(-1.0, 1.0, 3)
    spatial[:, 0] += rng.normal(0.0, noise_m, (len(t_s), 3))
    spatial += rng.normal(0.0, noise_m, spatial.shape) @ np.outer(normal, normal)
    # The body: zero at rest, or along the plane and then turned by the angle of its mount.
    zeroed, mount_rad = bool(rng.integers(2)), rng.uniform(0.0, np.pi / 3)
    turned = Rotation.from_rotvec(np.outer(angle_rad - zeroed * angle_rad[0], normal))
    if not zeroed:
        about = normal if rng.integers(2) else rng.normal(size=3)
        turned *= Rotation.from_rotvec(mount_rad * about / np.linalg.norm(about))
        turned *= Rotation.from_matrix(np.column_stack([right, up, normal]))
    turned = Rotation.from_rotvec(rng.normal(0.0, noise_m / BODY_M, (len(t_s), 3))) * turned
    degrees = bool(rng.integers(2)) and order != "quaternion"
    if order == "quaternion":
        values = turned.as_quat()
    elif order == "vector":
        values = turned.as_rotvec(degrees=degrees)
    else:
        in_order = turned.as_euler(order, degrees=degrees)
        values = in_order[:, [order.index(axis) for axis in "XYZ"]]
    unit = "" if order == "quaternion" or rng.integers(2) else f" [{'deg' if degrees else 'rad'}]"
    axes = ("Roll", "Pitch", "Yaw") if form == "roll" else "XYZW"[: values.shape[1]]
    names = ["time [s]", *(f"{p} {a} [mm]" for p in ("Gripper", *MARKERS) for a in "XYZ")]
    names += [pattern.format(axis) + unit for axis in axes]
    rows = np.column_stack([t_s, 1e3 * spatial.reshape(len(t_s), -1), values])
    head = f"Rotation Type,{order}\n\n" if form == "stated" else ""
    file = saved(folder / "a.csv", head + lines([names, *cells(rows, 7)]))
    told = f"{form} {order}{unit} {'deg' if degrees else 'rad'}, mount {np.degrees(mount_rad):.0f}°"
    return Variant(file, angle_rad, f"{told}, zeroed {zeroed}, noise {noise_m * 1e3:.2f} mm")


def understood(variant: Variant, angle_rad: float | None = None) -> Understanding:
    files = Files("a", "a.csv", read_capture(variant.file))
    stated = Stated("a", LENGTH_M, 0.0074, 0.016, 1e-4, clamp_angle_rad=angle_rad)
    return understand([files], stated)


def errors_rad(variant: Variant, section: AngleSection, found: Understanding) -> list[float]:
    """Mean errors at rest, and after the motion."""
    capture = read_capture(variant.file)
    angle_rad = clamp_angle_rad(capture, section, found.mapping.axes)
    assert angle_rad is not None
    off = angle_rad - variant.angle_rad
    return [float(np.mean(off[: int(0.4 * RATE_HZ)])), float(np.mean(off[-int(0.7 * RATE_HZ) :]))]


@pytest.mark.parametrize("seed", range(20))
def test_the_angle_is_the_clamp_s_in_any_convention(seed: int, tmp_path: Path) -> None:
    variant = made_variant(seed, tmp_path)
    found = understood(variant)
    angle = found.mapping.hand.angle
    assert angle != AngleSection(), variant.told
    errors = errors_rad(variant, angle, found)
    assert np.abs(errors).max() < LIMIT_RAD, (variant.told, np.degrees(errors), angle)


def rewritten(variant: Variant, change: dict[str, float]) -> Variant:
    """The variant with columns of those names multiplied; 0 takes a column out."""
    rows = [line.split(",") for line in variant.file.read_text().splitlines()]
    kept = [k for k, name in enumerate(rows[0]) if change.get(name, 1.0) != 0.0]
    factors = [change.get(rows[0][k], 1.0) for k in kept]
    table = np.array([[row[k] for k in kept] for row in rows[1:]], dtype=float) * factors
    names = [rows[0][k] for k in kept]
    file = saved(variant.file.with_name("b.csv"), lines([names, *cells(table, 7)]))
    return replace(variant, file=file)


def test_an_angle_that_turns_otherwise_is_none_of_the_clamp(tmp_path: Path) -> None:
    """One of three angles in a plane oblique to all axes correlates with the clamp's."""
    variant = made_variant(3, tmp_path)
    names = [name for name in read_capture(variant.file).names if "Gripper R" in name]
    alone = rewritten(variant, {names[0]: 0.0, names[1]: 0.0, names[2]: 0.6})
    found = understood(alone)
    assert found.mapping.hand.angle == AngleSection()
    (finding,) = [f for f in found.findings if f.entry == "hand.angle"]
    assert finding.sure is Sure.MISSING
    assert f"{names[2]!r} does not turn by as much as the cable's root" in finding.sentence
    stated = understood(alone, 0.1).mapping.hand.angle
    assert stated == AngleSection(constant_rad=0.1)


def test_a_quaternion_that_turns_otherwise_is_none_of_the_clamp(tmp_path: Path) -> None:
    variant = made_variant(4, tmp_path)
    found = understood(rewritten(variant, {f"Gripper Q{axis}": 0.4 for axis in "XYZ"}))
    assert found.mapping.hand.angle == AngleSection()


def test_a_column_called_the_angle_is_checked_against_the_root(tmp_path: Path) -> None:
    variant = made_variant(0, tmp_path)
    rows = variant.file.read_text().splitlines()[2:]
    rows[0] += ",gripper_angle_rad"
    rows[1:] = [f"{r},{a:.6f}" for r, a in zip(rows[1:], 0.5 * variant.angle_rad, strict=True)]
    table = replace(variant, file=saved(tmp_path / "c.csv", "\n".join(rows) + "\n"))
    without = {f"Gripper Rotation {axis}": 0.0 for axis in "XYZ"}
    found = understood(rewritten(table, without))
    about = [f for f in found.findings if f.entry == "hand.angle"]
    assert {f.sure for f in about} == {Sure.GUESSED}
    assert "does not turn by as much as 'gripper_angle_rad'" in about[0].sentence


@pytest.mark.parametrize("missing", ["order", "radians_per_unit", "body_axis"])
def test_three_angles_need_an_order_a_unit_and_an_axis(missing: str) -> None:
    entries = {"order": "XYZ", "radians_per_unit": 1.0, "body_axis": "-x"}
    entries = {key: value for key, value in entries.items() if key != missing}
    angle = AngleSection.model_validate({"rotation": ["a", "b", "c"], **entries})
    ((key, message),) = gripper_complaints(GripperSection(fixed_m=(0.0, 0.0), angle=angle))
    assert key == ("hand", "angle", missing)
    assert "give" in message
