"""Recorded cycles: of many cables, for learning their model; of one cable, merged into a study."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, Key, read_yaml
from cell.identify.noise import still_frames
from cell.records.folder import is_cycle, read_record
from cell.records.result import Outcome
from cell.study.data import Study, Trial
from cell.study.folder import read_study, study_folder
from cell.study.independence import without_copies
from cell.study.left_out import without_outliers

#: Relative tolerance of datasheets of the same cable.
SAME = 1e-6
#: Reason to omit a cycle that ended, or was killed, before its study was written.
UNMEASURED = "nothing was measured"
NONE_MEASURED = "no cycle here has measurements"
#: Reason to omit a cycle with the name of another one.
_TWICE = "the same as {}, or called so; if it is another cable, rename its folder"


@dataclass(frozen=True, eq=False)
class RecordedCycle:
    """The recorded measurements of one cable.

    held      the hold for identification; None = a measurement with its own motions
    executed  the execution; None = there was none
    product   of the cycle; None = its settings have no products
    """

    name: str
    folder: Path
    study: Study
    held: Trial | None
    executed: Trial | None
    outcome: Outcome | None
    product: str | None = None


def read_cycles(
    runs: Sequence[Path], cable: Cable, product: str | None = None
) -> tuple[list[RecordedCycle], list[str]]:
    """Cycles of folders or their subfolders, oldest first; and the cycles left out, with reasons.

    Each counts once, also if a folder occurs repeatedly: a copy is not another cable.
    product  cycles of another product, or of none, are omitted; None = cycles with a product are
    raises  InputError: a folder without a cycle, one of another datasheet, or none usable
    """
    cycles: list[RecordedCycle] = []
    left_out: list[str] = []
    folders: dict[str, Path] = {}
    for folder in _folders(runs):
        if first := folders.get(folder.resolve().name):
            left_out.append(f"{folder}: {_TWICE.format(first)}")
            continue
        cycle = _recorded_cycle(folder)
        if cycle is None:
            left_out.append(f"{folder}: {UNMEASURED}")
            continue
        if cycle.product != product:
            left_out.append(f"{folder}: of {_of(cycle.product)}, not of {_of(product)}")
            continue
        for name, value in cable.numbers.items():
            stated = cycle.study.cable.numbers[name]
            if not np.isclose(stated, value, rtol=SAME, atol=0.0):
                message = f"is {stated:g}, but {value:g} in the settings; learn from one kind only"
                place = folder / "study" / "study.yaml"
                raise InputError.at(place, message, key=f"cable.{name}")
        cycles.append(cycle)
        folders[cycle.name] = folder
    if not cycles:
        why = NONE_MEASURED if product is None else f"{NONE_MEASURED} of product {product}"
        raise InputError.at(Path(runs[0]), why)
    return sorted(cycles, key=lambda c: c.name), left_out


def measured(runs: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The folders without cycles that recorded no study; and a note on each omitted one.

    raises  InputError: none remains
    """
    empty = [
        run
        for run in runs
        if is_cycle(run) and not any((at / "study.yaml").exists() for at in (run, run / "study"))
    ]
    if runs and len(empty) == len(runs):
        raise InputError.at(Path(runs[0]), NONE_MEASURED)
    return [run for run in runs if run not in empty], [f"{run}: {UNMEASURED}" for run in empty]


def _folders(runs: Sequence[Path]) -> Iterator[Path]:
    for run in runs:
        if is_cycle(run) or (run / "study.yaml").exists():
            yield run
            continue
        inside = sorted(p.parent for p in run.glob("*/state.json")) if run.is_dir() else []
        if not inside:
            message = "holds no recorded cycle (state.json) and no study (study.yaml)"
            raise InputError.at(run, message)
        yield from inside


def _of(product: str | None) -> str:
    return "no product" if product is None else f"product {product}"


def _recorded_cycle(folder: Path) -> RecordedCycle | None:
    study, outcome, product = None, None, None
    if (folder / "state.json").exists():
        record = read_record(folder)
        study, outcome = record.study, record.result.outcome if record.result else None
        product = record.state.get("product")
    elif not is_cycle(folder):
        study = read_study(folder)
    if study is None:
        return None
    trials = {t.name: t for t in study.trials}
    held, executed = trials.get("identify"), trials.get("execute")
    return RecordedCycle(folder.resolve().name, folder, study, held, executed, outcome, product)


#: Settings that must agree, and what the study would mix otherwise.
SHARED = {
    ("camera",): "pictures of two camera settings",
    ("arm",): "motions of two arms",
    ("gripper",): "cables held in two ways",
    ("motion", "home"): "cables grasped in two poses",
    ("world",): "cables of two simulated worlds",
}
#: Settings of a simulated world's speed and mesh, which are no properties of its cables.
_PACE = {("world", "real_time_factor"), ("world", "segments")}
#: Tolerance of the rest shape of one cable in one attitude, as share of the free length;
#: individuals differ by a tenth.
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
    """One study, merged from the studies in cycles' folders (or from study folders).

    The first cycle keeps its roles; later cycles' trials are held out, so that the fit trials are
    of one recording.  Trials are named after their cycle's folder.  Noise of markers and wrenches,
    and uncertainty of arc lengths, are the largest stated ones.  Outliers of what the cell filmed
    and copies of other trials are omitted, with notes.
    raises  InputError: a folder has no study or occurs twice, two trials would have one name, or it
            is of another cable, markers, gravity, camera, arm, gripper or home, or of another
            individual
    """
    if not runs:
        raise ValueError("no cycle given")
    cycles = [_read(run) for run in runs]
    first, *others = cycles
    problems = [*_duplicates(cycles), *(p for cycle in others for p in _differences(first, cycle))]
    if others and not problems:  # a single study is of one cable as stated
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
    merged = replace(first.study, name=name, trials=tuple(trials), notes=notes)
    return without_copies(_with_largest_errors(merged, [cycle.study for cycle in cycles]))


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


def _read(run: Path) -> _Cycle:
    folder = study_folder(run)
    study = read_study(folder)
    if folder != run:
        study = without_outliers(replace(study, filmed=True))
    settings = run / "settings.yaml"
    return _Cycle(
        run.resolve().name, folder, study, read_yaml(settings) if settings.exists() else None
    )


def _duplicates(cycles: Sequence[_Cycle]) -> Iterator[Problem]:
    for i, cycle in enumerate(cycles):
        if cycle.name in {c.name for c in cycles[:i]}:
            message = f"{cycle.name!r} is given twice; trials are named after it: leave one out"
            yield Problem(cycle.folder / "study.yaml", 1, None, "", message)
            return
    owners: dict[str, Path] = {}
    for cycle in cycles:
        for trial in cycle.study.trials:
            name = _merged_name(cycle, trial)
            owner = owners.setdefault(name, cycle.folder)
            if owner != cycle.folder:
                message = f"a trial of {owner} would be called {name!r}, too; rename one folder"
                yield Problem(cycle.folder / "study.yaml", 1, None, "trials", message)


def _differences(first: _Cycle, other: _Cycle) -> Iterator[Problem]:
    """Problems of merging two cycles, by datasheet and settings."""
    header = other.folder / "study.yaml"
    first_sheet, other_sheet = (_sheet(c.study) for c in (first, other))
    for field, value in first_sheet.items():
        stated = other_sheet[field]
        if value.shape != stated.shape or not np.allclose(value, stated, rtol=SAME):
            message = (
                f"is {_values(stated)}, but {_values(value)} in {first.folder}; merge them apart"
            )
            yield Problem(header, 1, None, field, message)
    if first.settings is None or other.settings is None:
        return
    for key, mixed in SHARED.items():
        was, now = (dict(_leaves(_at(d.data, key), key)) for d in (first.settings, other.settings))
        for leaf in sorted({*was, *now} - _PACE):
            if was.get(leaf) != now.get(leaf):
                message = (
                    f"is {now.get(leaf)}, but {was.get(leaf)} in {first.settings.path}: {mixed} "
                    "do not make one study; merge them apart"
                )
                yield other.settings.problem(leaf if leaf in now else key, message)


def _sheet(study: Study) -> dict[str, FloatArray]:
    """Stated properties of cable and markers."""
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
    """Problems of trials whose rest shape differs from an earlier one in the same attitude."""
    earlier: list[tuple[float, FloatArray, str]] = []
    for cycle in cycles:
        study = cycle.study
        limit_m = max(SAME_SHAPE * study.cable.free_length_m, 6.0 * (study.noise_std_m or 0.0))
        for trial in study.trials:
            hanging = _hanging(trial)
            if hanging is None:
                continue
            angle, shape_m = hanging
            for other_angle, other_m, where in earlier:
                if abs(angle - other_angle) > SAME_ANGLE_RAD:
                    continue
                distances = np.linalg.norm(shape_m - other_m, axis=1)
                apart_m = float(np.max(distances[np.isfinite(distances)], initial=0.0))
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
                earlier.append((angle, shape_m, f"{cycle.name}/{trial.name}"))


def _hanging(trial: Trial) -> tuple[float, FloatArray] | None:
    """Clamp angle and mean place of the markers relative to the gripper, at rest."""
    t_s, grip = trial.markers.t_s, trial.grip
    still = still_frames(t_s, grip, trial.release_s)
    from_gripper_m = trial.markers.xy_m[still] - [grip.x_m[0], grip.y_m[0]]
    if trial.start != "equilibrium" or len(from_gripper_m) == 0:
        return None
    observed = np.isfinite(from_gripper_m)
    count = observed.sum(axis=0)
    total = np.sum(np.where(observed, from_gripper_m, 0.0), axis=0)
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
