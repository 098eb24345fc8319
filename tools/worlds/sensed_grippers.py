"""Studies whose gripper motion comes from an encoder or accelerometer, imported from files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.geometry import GRAVITY_M_PER_S2, Motion
from cell.files.atomic import write_all
from cell.study.data import Study
from cell.study.hand_drift import HandDrift
from cell.study.imports.capture import TextForm
from cell.study.imports.convert import read_captures, study_of
from cell.study.imports.gripper_section import (
    AccelerationSection,
    AngleSection,
    AxesSection,
    GripperSection,
    TimeSection,
    TurnsSection,
)
from cell.study.imports.mapping import (
    FILE,
    FORMAT,
    CableSection,
    Mapping,
    MarkerEntry,
    TrialEntry,
    read_mapping,
)
from cell.study.imports.write import mapping_text
from cell.study.table import table_text

#: Accelerometer: noise of a sample and offset, m/s², samples a second.
NOISE, OFFSET, RATE_HZ = 0.02, 0.1, 1000.0
DENSITY = NOISE * float(np.sqrt(2.0 / RATE_HZ))
#: Encoder: samples a second.
ENCODER_HZ = 500.0
_TABLE = TextForm(separator=",", decimal=".")
_PLANE = AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
_TIME = TimeSection(column="t_s", seconds_per_unit=1.0)


def arc(hand: Motion, radius_m: float, way_m: tuple[float, float]) -> Motion:
    """Motion of a gripper on a rotating arm, along an arc as long as the way of `hand`.

    Its clamp angle is the initial one of `hand`; down or to the left it turns downwards.
    """
    done = np.hypot(hand.x_m, hand.y_m) / radius_m
    turn = hand.angle_rad + (1.0 if way_m[0] + way_m[1] < 0.0 else -1.0) * done
    return Motion(hand.t_s, -radius_m * np.cos(turn), -radius_m * np.sin(turn), turn)


def drift_of(hand: Motion) -> HandDrift:
    """Drift that remains unknown in a motion integrated from an accelerometer."""
    moves = np.flatnonzero(np.hypot(np.diff(hand.x_m), np.diff(hand.y_m)) > 0.0)
    from_s, to_s = float(hand.t_s[moves[0]]), float(hand.t_s[moves[-1] + 1])
    return HandDrift(from_s, to_s, (DENSITY, DENSITY))


def by_encoder(study: Study, radius_m: float, counts: int) -> Study:
    """The study with each gripper motion replaced by encoder counts, `counts` per turn."""
    logs = []
    for trial in study.trials:
        t_s, (_, _, angle) = _at(trial.grip, ENCODER_HZ)
        logs.append(np.column_stack([t_s, np.round(angle / (2.0 * np.pi) * counts)]))
    turns = TurnsSection(
        column="encoder", radians_per_unit=2.0 * np.pi / counts, axle_m=(0.0, 0.0),
        radius_m=radius_m,
    )  # fmt: skip
    hand = GripperSection(turns=turns, angle=AngleSection(follows=True), text=_TABLE, time=_TIME)
    return _import(study, hand, ("t_s", "encoder"), logs)


def by_accelerometer(study: Study, rng: np.random.Generator) -> Study:
    """The study with grippers as measured by a sensor at the clamp and a log of the angle."""
    logs = []
    offset = OFFSET * rng.choice([-1.0, 1.0], 2)
    for trial in study.trials:
        t_s, (_, _, angle) = _at(trial.grip, RATE_HZ)
        grip = trial.grip
        bent = (CubicSpline(grip.t_s, v).derivative(2)(t_s) for v in (grip.x_m, grip.y_m))
        x, y = (a - g for a, g in zip(bent, GRAVITY_M_PER_S2, strict=True))
        c, s = np.cos(angle), np.sin(angle)
        shown = np.column_stack([c * x + s * y, c * y - s * x]) + offset
        shown += NOISE * rng.normal(size=shown.shape)
        logs.append(np.column_stack([t_s, shown, angle]))
    sensor = AccelerationSection(
        columns=["acc_x", "acc_y"], m_per_s2_per_unit=1.0, along="clamp", starts_at_m=(0.0, 0.0)
    )
    angle_section = AngleSection(column="angle", radians_per_unit=1.0)
    hand = GripperSection(acceleration=sensor, angle=angle_section, text=_TABLE, time=_TIME)
    return _import(study, hand, ("t_s", "acc_x", "acc_y", "angle"), logs)


def _at(grip: Motion, rate_hz: float) -> tuple[np.ndarray, list[np.ndarray]]:
    t_s = np.arange(grip.t_s[0], grip.t_s[-1], 1.0 / rate_hz)
    values = (grip.x_m, grip.y_m, grip.angle_rad)
    return t_s, [CubicSpline(grip.t_s, v)(t_s) for v in values]


def _import(
    study: Study, hand: GripperSection, columns: Sequence[str], logs: Sequence[np.ndarray]
) -> Study:
    """The study after an import from files and a mapping, which may state less of it."""
    names = [f"m{i}" for i in range(len(study.arc_length_m))]
    places = [f"{n}_{a}" for n in names for a in "xy"]
    mapping = Mapping(
        format=FORMAT,
        name=study.name,
        cable=CableSection(**study.cable.to_dict()),
        noise_std_m=study.noise_std_m,
        text=_TABLE,
        time=_TIME,
        metres_per_unit=1.0,
        axes=_PLANE,
        hand=hand,
        markers=[
            MarkerEntry(name=n, columns=[f"{n}_x", f"{n}_y"], arc_length_m=float(s))
            for n, s in zip(names, study.arc_length_m, strict=True)
        ],
        trials=[
            TrialEntry(
                name=t.name,
                file=f"{t.name}.csv",
                hand_file=f"{t.name}_hand.csv",
                role=t.role,
                start=t.start,
                release_s=t.release_s,
            )
            for t in study.trials
        ],
    )
    with TemporaryDirectory() as place:
        folder = Path(place)
        files: dict[Path, str | bytes] = {folder / FILE: mapping_text(mapping, (), "")}
        for trial, log in zip(study.trials, logs, strict=True):
            markers = trial.markers
            rows = np.column_stack([markers.t_s, markers.xy_m.reshape(len(markers.t_s), -1)])
            files[folder / f"{trial.name}.csv"] = table_text(("t_s", *places), rows)
            files[folder / f"{trial.name}_hand.csv"] = table_text(columns, log)
        write_all(files)
        read = read_mapping(folder / FILE)
        return study_of(read, read_captures(read)).study


def turning(hand: Motion, by_rad: float) -> Motion:
    """The motion with a clamp angle that changes by `by_rad` in proportion to the way."""
    way = np.hypot(hand.x_m, hand.y_m)
    return replace(hand, angle_rad=hand.angle_rad + by_rad * way / way[-1])
