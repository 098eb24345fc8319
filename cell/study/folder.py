"""Reads and writes studies as folders in the form cable-study/1: one YAML file and CSV tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cell.cable.geometry import Cable, Motion, Start
from cell.files.atomic import write_all
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, Key, read_yaml, validate, yaml_text
from cell.study.checks import check_finite, check_times, check_whole, exchanged
from cell.study.data import Markers, Source, Study, Trial
from cell.study.plausible import clocks_differ, doubt, impossible
from cell.study.table import read_table, table_text

FloatArray = NDArray[np.float64]

FORMAT = "cable-study/1"
GRIP_COLUMNS = ("t_s", "x_m", "y_m", "angle_rad")

#: Beyond these a number is taken for a mistaken unit.
MAX_LENGTH_M = 10.0
MIN_GRAVITY_M_PER_S2, MAX_GRAVITY_M_PER_S2 = 0.01, 100.0
MAX_NOISE_FRACTION = 0.2
MAX_DISTANCE_M = 100.0
#: Of a marker; nearer ones are told with their distance from the hand.
MAX_COORDINATE_M = 1e6

#: Frames of a trial that are taken; a fit's time and memory grow with them.
MAX_FRAMES = 5_000
MAX_MARKERS = 200
MAX_TRIALS = 500

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Cable(_Strict):
    free_length_m: _Positive
    line_density_kg_per_m: _Positive
    width_m: _Positive | None = None
    thickness_m: _Positive | None = None
    diameter_m: _Positive | None = None

    def datasheet(self) -> Cable | None:
        """A round cable as a strip as wide that has the same section; None: neither or both."""
        across = self.width_m, self.thickness_m
        if self.diameter_m is not None and across == (None, None):
            across = self.diameter_m, np.pi / 4.0 * self.diameter_m
        elif self.diameter_m is not None:
            return None
        width_m, thickness_m = across
        if width_m is None or thickness_m is None:
            return None
        return Cable(self.free_length_m, self.line_density_kg_per_m, width_m, thickness_m)


class _Markers(_Strict):
    arc_length_m: Annotated[list[_Finite], Field(min_length=1, max_length=MAX_MARKERS)]


class _Trial(_Strict):
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    role: Literal["fit", "validate"]
    start: Start
    release_s: _Finite | None = None


class _Study(_Strict):
    format: Literal["cable-study/1"]
    name: Annotated[str, Field(min_length=1)]
    cable: _Cable
    gravity_m_per_s2: tuple[_Finite, _Finite] = (0.0, -9.81)
    markers: _Markers
    noise_std_m: _Positive | None = None
    trials: Annotated[list[_Trial], Field(min_length=1, max_length=MAX_TRIALS)]


def read_study(folder: Path) -> Study:
    """The study in a folder, markers ordered tip first whatever their order in the file.

    Of a trial of more than `MAX_FRAMES` frames every second, third, … is taken.  This, and what is
    odd and yet possible, is said in the study's notes.

    raises  InputError: a file is missing or wrong; every problem names file, line, value,
            limit and remedy
    """
    document = read_yaml(folder / "study.yaml")
    header = validate(document, _Study)
    cable = header.cable.datasheet()
    problems = _implausible(document, header, cable)
    if cable is None or problems:
        raise InputError(problems)

    arc_length_m = np.array(header.markers.arc_length_m)
    order = np.argsort(-arc_length_m)
    trials: list[Trial] = []
    notes: list[str] = []
    for trial in header.trials:
        try:
            read = _read_trial(folder / trial.name, trial, (header, cable), order)
        except InputError as error:
            problems.extend(error.problems)
            continue
        looked_at = (read, cable, arc_length_m[order], header.gravity_m_per_s2)
        markers = folder / trial.name / "markers.csv"
        if places := exchanged(read.markers):
            problems.append(places)
        elif found := impossible(*looked_at):
            line = read.markers.line(found.row)
            problems.append(Problem(markers, line, None, "", found.cause))
        elif odd := doubt(*looked_at):
            notes.append(f"{markers}: {odd}")
        step = -(-len(read.markers.t_s) // MAX_FRAMES)
        if step > 1:
            notes.append(
                f"{markers}: one of every {step} of the {len(read.markers.t_s)} frames is taken; "
                f"a swing needs no more than {MAX_FRAMES}"
            )
            read = replace(read, markers=_every(step, read.markers))
        trials.append(read)
    if problems:
        raise InputError(problems)
    return Study(
        name=header.name,
        cable=cable,
        arc_length_m=arc_length_m[order],
        trials=tuple(trials),
        gravity_m_per_s2=header.gravity_m_per_s2,
        noise_std_m=header.noise_std_m,
        notes=tuple(notes),
    )


def study_folder(folder: Path) -> Path:
    """The folder of a study, given it or that of the recorded cycle that holds it in `study/`.

    raises  InputError: it holds several cycles instead
    """
    if (folder / "study.yaml").exists():
        return folder
    if (folder / "study" / "study.yaml").exists():
        return folder / "study"
    cycles = sorted(p.parents[1].name for p in folder.glob("*/study/study.yaml"))
    if cycles:
        raise InputError.at(
            folder,
            f"holds recorded cycles, not a study; name one of them, {folder / cycles[0]} for one, "
            f"or gather those of one cable: cell study {folder}/* -o STUDY",
        )
    return folder


def write_study(study: Study, folder: Path) -> None:
    """Write a study so that `read_study` gives it back to the last bit.

    All files are written before the first takes its place, `study.yaml` the last: where the disk is
    full, a reader meets the former study.

    raises  OSError: it cannot be written; nothing has changed
    """
    files: dict[Path, str | bytes] = {}
    for trial in study.trials:
        grip, markers = trial.grip, trial.markers
        files[folder / trial.name / "grip.csv"] = table_text(
            GRIP_COLUMNS,
            np.column_stack([grip.t_s, grip.x_m, grip.y_m, grip.angle_rad]),
        )
        files[folder / trial.name / "markers.csv"] = table_text(
            _marker_columns(len(study.arc_length_m)),
            np.column_stack([markers.t_s, markers.xy_m.reshape(len(markers.t_s), -1)]),
        )
    header: dict[str, object] = {
        "format": FORMAT,
        "name": study.name,
        "cable": {k: float(v) for k, v in vars(study.cable).items()},
        "gravity_m_per_s2": [float(g) for g in study.gravity_m_per_s2],
        "markers": {"arc_length_m": [float(s) for s in study.arc_length_m]},
    }
    if study.noise_std_m is not None:
        header["noise_std_m"] = float(study.noise_std_m)
    header["trials"] = [
        {"name": t.name, "role": t.role, "start": t.start}
        | ({} if t.release_s is None else {"release_s": float(t.release_s)})
        for t in study.trials
    ]
    files[folder / "study.yaml"] = yaml_text(header)
    write_all(files)


def _marker_columns(count: int) -> tuple[str, ...]:
    return ("t_s", *(f"{axis}{i}_m" for i in range(count) for axis in "xy"))


def _implausible(document: Document, header: _Study, datasheet: Cable | None) -> list[Problem]:
    """What a schema cannot say: mistaken units and entries that contradict each other."""
    problems: list[Problem] = []

    def add(key: Key, message: str) -> None:
        problems.append(document.problem(key, message))

    for name in ("free_length_m", "width_m", "thickness_m", "diameter_m"):
        value = getattr(header.cable, name)
        if value is not None and value > MAX_LENGTH_M:
            add(
                ("cable", name),
                f"{value:g} m is beyond {MAX_LENGTH_M:g} m; give metres, not millimetres",
            )
    if datasheet is None:
        given = [n for n in ("width_m", "thickness_m", "diameter_m") if getattr(header.cable, n)]
        add(
            ("cable",),
            f"{' and '.join(given) or 'no section'} given; a flat cable has width_m and "
            "thickness_m, a round one diameter_m alone",
        )
    implausible = datasheet.implausible() if datasheet else None
    if implausible and not problems:
        add(("cable", "line_density_kg_per_m"), implausible)
    size = np.hypot(*header.gravity_m_per_s2)
    if size < MIN_GRAVITY_M_PER_S2:
        add(
            ("gravity_m_per_s2",),
            f"{list(header.gravity_m_per_s2)} is below {MIN_GRAVITY_M_PER_S2:g} m/s²: only beside "
            "its weight is a cable's rigidity known; give [0.0, -9.81]",
        )
    elif size > MAX_GRAVITY_M_PER_S2:
        add(
            ("gravity_m_per_s2",),
            f"{list(header.gravity_m_per_s2)} is beyond {MAX_GRAVITY_M_PER_S2:g} m/s²; "
            "give m/s², not mm/s²",
        )
    elif header.gravity_m_per_s2[1] > 0.0:
        add(
            ("gravity_m_per_s2",),
            f"{list(header.gravity_m_per_s2)} points up, for y is up; give [0.0, -9.81], and all y "
            "upwards",
        )

    arcs = header.markers.arc_length_m
    for i, arc in enumerate(arcs):
        if not 0.0 <= arc <= header.cable.free_length_m * (1 + 1e-9):
            add(
                ("markers", "arc_length_m", i),
                f"{arc:g} m is not on the cable, 0 … {header.cable.free_length_m:g} m; "
                "count from the gripping point, in metres",
            )
    sign = np.sign(np.diff(arcs))
    for i in map(int, np.flatnonzero((sign != sign[:1]) | (sign == 0.0))):
        add(
            ("markers", "arc_length_m", i + 1),
            f"{arcs[i + 1]:g} m after {arcs[i]:g} m: markers cross or coincide; "
            "order them along the cable",
        )
    if header.noise_std_m and header.noise_std_m > MAX_NOISE_FRACTION * header.cable.free_length_m:
        add(
            ("noise_std_m",),
            f"{header.noise_std_m:g} m is beyond {MAX_NOISE_FRACTION:g} of the free length; "
            "give metres, not millimetres",
        )

    seen: dict[str, int] = {}
    for i, trial in enumerate(header.trials):
        key: Key = ("trials", i)
        if trial.name in seen:
            add((*key, "name"), f"{trial.name!r} is also trial {seen[trial.name] + 1}; rename one")
        seen.setdefault(trial.name, i)
        if trial.start in ("straight", "held") and trial.release_s is None:
            needs = f"is missing; `start: {trial.start}` needs the time of letting go"
            add((*key, "release_s"), needs)
        if trial.start in ("equilibrium", "moving") and trial.release_s is not None:
            only = "is only for `start: straight` and `held`; remove it or change `start`"
            add((*key, "release_s"), only)
    return problems


def read_grip(path: Path) -> Motion:
    """Read the log of a hand: t_s, x_m, y_m, angle_rad.  Raises InputError."""
    grip = read_table(path, GRIP_COLUMNS)
    check_times(grip)
    check_finite(grip)
    grip.check(
        np.abs(grip.values) <= [np.inf, MAX_DISTANCE_M, MAX_DISTANCE_M, 2 * np.pi],
        lambda name: (
            "is beyond ±2π; give radians, not degrees"
            if name == "angle_rad"
            else f"is beyond ±{MAX_DISTANCE_M:g} m; give metres"
        ),
    )
    check_whole(grip)
    return Motion(*grip.values.T)


def _read_trial(
    folder: Path, trial: _Trial, of: tuple[_Study, Cable], order: NDArray[np.intp]
) -> Trial:
    header, cable = of
    motion = read_grip(folder / "grip.csv")
    count = len(header.markers.arc_length_m)
    table = read_table(folder / "markers.csv", _marker_columns(count))
    check_times(table)
    t_s = table.values[:, 0]
    xy_m = table.values[:, 1:].reshape(len(t_s), count, 2)
    if np.isnan(xy_m).all():
        raise table.error(
            2, None, f"no marker is seen in any of {len(t_s)} rows; remove the trial or its nan"
        )
    if t_s[-1] < motion.t_s[0] or t_s[0] > motion.t_s[-1]:
        raise table.error(
            2,
            "t_s",
            f"markers span {t_s[0]:g} … {t_s[-1]:g} s, grip.csv {motion.t_s[0]:g} … "
            f"{motion.t_s[-1]:g} s, without overlap; put both on one clock, in seconds",
        )
    table.check(
        ~(np.abs(table.values) > [np.inf, *[MAX_COORDINATE_M] * (2 * count)]),
        lambda _: f"is beyond ±{MAX_COORDINATE_M:g} m; give metres",
    )
    grip_xy_m = np.column_stack([np.interp(t_s, motion.t_s, v) for v in (motion.x_m, motion.y_m)])
    # A marker cannot be farther from the hand than the cable is long; half as far again leaves
    # room for noise, a slipping grip and a clock that is off, and none for millimetres.
    limit_m = 1.5 * header.cable.free_length_m
    # A coordinate that was not seen adds nothing: what is left is the least that it can be.
    away_m = np.nan_to_num(xy_m - grip_xy_m[:, None])
    distance_m = np.hypot(away_m[..., 0], away_m[..., 1])
    near = ~(distance_m > limit_m)
    source = Source(table.path, np.array(table.lines), order)
    markers = Markers(t_s, xy_m[:, order], source)
    read = Trial(trial.name, trial.role, trial.start, motion, markers, trial.release_s)
    shifted = None if near.all() else clocks_differ(read, cable, header.gravity_m_per_s2)
    if shifted is not None:
        raise table.error(table.lines[shifted.row], "t_s", shifted.cause)
    table.check(
        np.column_stack([np.ones(len(t_s), bool), np.repeat(near, 2, axis=1)]),
        lambda _: (
            f"lies more than {limit_m:g} m (1.5 free lengths) from the gripping point; "
            "give metres, in the frame of grip.csv"
        ),
    )
    return read


def _every(step: int, markers: Markers) -> Markers:
    """One of so many frames."""
    source = markers.source
    if source is not None:
        source = replace(source, lines=source.lines[::step])
    return Markers(markers.t_s[::step], markers.xy_m[::step], source)
