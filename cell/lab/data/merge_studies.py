"""Recorded cycles of one cable, merged into one study."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, Key, read_yaml
from cell.identify.noise import still_frames
from cell.lab.data.cycles import measured
from cell.study.data import Study, Trial
from cell.study.folder import read_study, study_folder, write_study
from cell.study.independence import without_copies
from cell.study.left_out import without_outliers

#: Datasheets of the same cable agree to this.
SAME = 1e-6
#: Settings that must agree, and what the cable's motion in the study otherwise mixes.
SHARED = {
    ("camera",): "pictures of two camera settings",
    ("arm",): "motions of two arms",
    ("gripper",): "cables held in two ways",
    ("motion", "home"): "cables grasped in two poses",
    ("world",): "cables of two simulated worlds",
}
#: How fast a simulated world runs, and how finely, is not a property of its cables.
_PACE = {("world", "real_time_factor"), ("world", "segments")}
#: The same cable in the same attitude hangs alike to this share of its free length; individuals
#: differ by a tenth.
SAME_SHAPE = 0.02
SAME_ANGLE_RAD = 0.01


@dataclass(frozen=True)
class _Cycle:
    """A cycle's study and, if it was recorded by a cell, the settings."""

    name: str
    folder: Path
    study: Study
    settings: Document | None


def merge_studies(runs: Sequence[Path], name: str) -> Study:
    """One study, merged from the studies in cycles' folders (or from given studies).

    The first cycle's roles are kept; later cycles' trials are only compared with, so that what was
    fitted stays what one cable showed.  Trials are named after their cycle's folder.  The noise of
    markers and wrenches, and the uncertainty of arc lengths, is the largest that any of them
    states.  Wrong samples of what the cell filmed are left out, and copies of other trials; the
    notes say which.
    raises  InputError: a folder has no study or is given twice, two trials have one name then, or
            it is of another cable, markers, gravity, camera, arm, gripper or home, or shows
            another individual
    """
    if not runs:
        raise ValueError("no cycle given")
    cycles = [_read(run) for run in runs]
    first, *others = cycles
    problems = [*_twice(cycles), *(p for cycle in others for p in _apart(first, cycle))]
    if others and not problems:  # one study alone is of one cable, as whoever wrote it says
        problems = list(_individuals(cycles))
    if problems:
        raise InputError(problems)
    trials = [
        replace(
            trial,
            name=trial.name if len(cycles) == 1 else _merged_name(cycle, trial),
            role=trial.role if cycle is first else "validate",
        )
        for cycle in cycles
        for trial in cycle.study.trials
    ]
    notes = tuple(note for cycle in cycles for note in cycle.study.notes)
    made = replace(first.study, name=name, trials=tuple(trials), notes=notes)
    return without_copies(_with_largest_errors(made, [cycle.study for cycle in cycles]))


def _merged_name(cycle: _Cycle, trial: Trial) -> str:
    return f"{cycle.name}_{trial.name}"


def _with_largest_errors(study: Study, merged: Sequence[Study]) -> Study:
    """The study with the largest errors that any of those merged states."""
    used = [s.sensor for s in merged if any(t.wrench is not None for t in s.trials)]
    sensors = used or [study.sensor]
    arcs = [s.arc_length_std_m for s in merged if s.arc_length_std_m is not None]
    return replace(
        study,
        noise_std_m=_largest(s.noise_std_m for s in merged),
        arc_length_std_m=np.max(arcs, axis=0) if arcs else None,
        sensor=replace(
            study.sensor,
            force_std_n=_largest(s.force_std_n for s in sensors),
            moment_std_nm=_largest(s.moment_std_nm for s in sensors),
            gain_std=max(s.gain_std for s in sensors),
        ),
    )


def _largest(stated: Iterable[float | None]) -> float | None:
    return max((value for value in stated if value is not None), default=None)


def merge_into(folder: Path, runs: Sequence[Path]) -> tuple[Study, list[str]]:
    """The studies of cycles merged into one, written to a folder and named after it.

    returns  the study; and which cycles were left out because nothing was measured in them
    raises   InputError: as `merge_studies`, or nothing was measured in any
    """
    found, left_out = measured(runs)
    study = merge_studies(found, folder.name)
    write_study(study, folder)
    return study, left_out


def _read(run: Path) -> _Cycle:
    folder = study_folder(run)
    study = read_study(folder)
    if folder != run:
        study = without_outliers(replace(study, filmed=True))
    settings = run / "settings.yaml"
    return _Cycle(
        run.resolve().name, folder, study, read_yaml(settings) if settings.exists() else None
    )


def _twice(cycles: Sequence[_Cycle]) -> Iterator[Problem]:
    for i, cycle in enumerate(cycles):
        if cycle.name in {c.name for c in cycles[:i]}:
            message = f"{cycle.name!r} is given twice; trials are named after it: leave one out"
            yield Problem(cycle.folder / "study.yaml", 1, None, "", message)
            return
    taken: dict[str, Path] = {}
    for cycle in cycles:
        for trial in cycle.study.trials:
            name = _merged_name(cycle, trial)
            there = taken.setdefault(name, cycle.folder)
            if there != cycle.folder:
                message = f"a trial of {there} would be called {name!r}, too; rename one folder"
                yield Problem(cycle.folder / "study.yaml", 1, None, "trials", message)


def _apart(first: _Cycle, other: _Cycle) -> Iterator[Problem]:
    """Why two cycles cannot be in one study, as far as data sheet and settings tell."""
    header = other.folder / "study.yaml"
    ours, theirs = (_sheet(c.study) for c in (first, other))
    for what, value in ours.items():
        shown = theirs[what]
        if value.shape != shown.shape or not np.allclose(value, shown, rtol=SAME):
            message = (
                f"is {_values(shown)}, but {_values(value)} in {first.folder}; merge them apart"
            )
            yield Problem(header, 1, None, what, message)
    if first.settings is None or other.settings is None:
        return
    for key, mixed in SHARED.items():
        were, are = (dict(_leaves(_at(d.data, key), key)) for d in (first.settings, other.settings))
        for leaf in sorted({*were, *are} - _PACE):
            if were.get(leaf) != are.get(leaf):
                message = (
                    f"is {are.get(leaf)}, but {were.get(leaf)} in {first.settings.path}: {mixed} "
                    "do not make one study; merge them apart"
                )
                yield other.settings.problem(leaf if leaf in are else key, message)


def _sheet(study: Study) -> dict[str, FloatArray]:
    """What is stated of cable and markers."""
    return {
        "cable": np.array(list(study.cable.numbers.values())),
        "markers.arc_length_m": study.arc_length_m,
        "gravity_m_per_s2": np.array(study.gravity_m_per_s2),
        "wrench": np.array([
            study.sensor.gauge.turns,
            study.sensor.gauge.tool.mass_kg,
            *study.sensor.gauge.tool.centre_m,
            study.sensor.gauge.tool.inertia_kg_m2,
        ]),
    }  # fmt: skip


def _individuals(cycles: Sequence[_Cycle]) -> Iterator[Problem]:
    """Trials whose cable hangs otherwise than one in the same attitude before it."""
    known: list[tuple[float, FloatArray, str]] = []
    for cycle in cycles:
        study = cycle.study
        limit_m = max(SAME_SHAPE * study.cable.free_length_m, 6.0 * (study.noise_std_m or 0.0))
        for trial in study.trials:
            hanging = _hanging(trial)
            if hanging is None:
                continue
            angle, shape_m = hanging
            for other_angle, other_m, where in known:
                if abs(angle - other_angle) > SAME_ANGLE_RAD:
                    continue
                apart = np.linalg.norm(shape_m - other_m, axis=1)
                apart_m = float(np.max(apart[np.isfinite(apart)], initial=0.0))
                if apart_m > limit_m:
                    message = (
                        f"the resting cable is {apart_m * 1e3:.1f} mm away from that of {where} at "
                        f"the same clamp angle (allowed {limit_m * 1e3:.1f} mm): another "
                        "individual, or gripped elsewhere; merge only cycles of one cable"
                    )
                    table = cycle.folder / trial.name / "markers.csv"
                    yield Problem(table, 2, None, "", message)
                    break
            else:
                known.append((angle, shape_m, f"{cycle.name}/{trial.name}"))


def _hanging(trial: Trial) -> tuple[float, FloatArray] | None:
    """Clamp angle and mean place of the markers relative to the gripper, at rest."""
    t_s, grip = trial.markers.t_s, trial.grip
    still = still_frames(t_s, grip, trial.release_s)
    from_gripper_m = trial.markers.xy_m[still] - [grip.x_m[0], grip.y_m[0]]
    if trial.start != "equilibrium" or len(from_gripper_m) == 0:
        return None
    seen = np.isfinite(from_gripper_m)
    count = seen.sum(axis=0)
    total = np.sum(np.where(seen, from_gripper_m, 0.0), axis=0)
    return float(grip.angle_rad[0]), np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _at(data: Any, key: Key) -> Any:
    for part in key:
        data = data.get(part, {}) if isinstance(data, Mapping) else {}
    return data


def _leaves(data: Any, key: Key) -> Iterator[tuple[Key, Any]]:
    """All single values below a key."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _leaves(value, (*key, str(name)))
    else:
        yield key, data


def _values(values: FloatArray) -> str:
    shown = ", ".join(f"{v:g}" for v in values[:6])
    return f"[{shown}{', …' if len(values) > 6 else ''}]"
