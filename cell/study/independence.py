"""Independence of trials: copies of one recording, and repetitions of one motion.

Copies of one recording are no independent evidence, see `same_recording`.  Repetitions of a motion
are independent recordings, but no evidence about held-out motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion
from cell.files.plain import plain
from cell.files.words import counted
from cell.study.data import Study, Trial
from cell.study.same_recording import originals, same_recordings

Names = tuple[str, ...]


@dataclass(frozen=True)
class Independence:
    """Trials of a study, grouped by recording and by motion.

    recordings  names of the trials of each recording: several are copies of one
    motions     the same of each motion
    held_out    number of motions without a trial in the fit
    """

    recordings: tuple[Names, ...] = ()
    motions: tuple[Names, ...] = ()
    held_out: int = 0

    @classmethod
    def of(cls, study: Study) -> Independence:
        """Of a study without copies, see `without_copies`."""
        copies = {name: names for names in study.copies for name in names}
        motions: list[list[Trial]] = []
        for trial in study.trials:
            length_m = study.cable.length_m
            repeated = (m for m in motions if same_motion(m[0], trial, length_m))
            known = next(repeated, None)
            if known is None:
                motions.append([trial])
            else:
                known.append(trial)
        return cls(
            tuple(copies.get(t.name, (t.name,)) for t in study.trials),
            tuple(tuple(n for t in m for n in copies.get(t.name, (t.name,))) for m in motions),
            sum(all(t.role == "validate" for t in motion) for motion in motions),
        )

    @property
    def effective_trials(self) -> float:
        """Number of independent trials."""
        return float(len(self.recordings))

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {"effective_trials": self.effective_trials, **plain(vars(self))}

    def __str__(self) -> str:
        trials, motions = sum(map(len, self.recordings)), counted(len(self.motions), "motion")
        return (
            f"effective trials {self.effective_trials:.1f} of {trials}, {motions}, "
            f"{self.held_out} held out"
        )


def without_copies(study: Study) -> Study:
    """The study with one trial per recording, and a note that lists the removed copies.

    The copy with most values stays; it is in the fit if any of them is.
    """
    recordings = same_recordings([t.markers for t in study.trials])
    if len(set(recordings)) == len(recordings):
        return study
    trials, known, notes = [], list(study.copies), []
    for first in dict.fromkeys(recordings):
        copies = [t for t, of in zip(study.trials, recordings, strict=True) if of == first]
        retained = max(copies, key=lambda t: int(np.isfinite(t.markers.xy_m).sum()))
        fitted = any(t.role == "fit" for t in copies)
        trials.append(replace(retained, role="fit") if fitted else retained)
        if len(copies) > 1:
            names = tuple(t.name for t in copies)
            known.append(names)
            notes.append(copies_text(names, retained.name))
    return replace(study, trials=tuple(trials), copies=tuple(known), notes=(*study.notes, *notes))


def without_copies_of(study: Study, others: Sequence[Study]) -> Study:
    """The study without copies of trials of other studies, and a note of each.

    raises  ValueError: no trial remains that a model could be fitted to
    """
    known = [(s.name, t) for s in others for t in s.trials]
    first = originals([t.markers for t in study.trials], [t.markers for _, t in known])
    trials, notes = [], []
    for trial, number in zip(study.trials, first, strict=True):
        if number is None:
            trials.append(trial)
            continue
        name, original = known[number]
        notes.append(
            f"trial {trial.name} of {study.name} and {original.name} of {name} are one recording: "
            f"their noise is the same. It is counted once, in {name}; record the motion again"
        )
    if not any(t.role == "fit" for t in trials):
        raise ValueError(f"{'; '.join(notes)}, or leave {study.name} out")
    return replace(study, trials=tuple(trials), notes=(*study.notes, *notes))


def copies_text(names: Sequence[str], used: str) -> str:
    """Message that trials are copies of one recording, with the remedy."""
    listed = f"{', '.join(names[:-1])} and {names[-1]}"
    return (
        f"{listed} are one recording: their noise is the same. It is counted once, as {used}, and "
        "confirms nothing by itself; record the motion again"
    )


#: Tolerance for equal motions of the gripper: share of the longer way, and clamp angle, rad.
SAME_WAY, SAME_ANGLE_RAD = 0.02, 0.02
#: A gripper that moves by less than this share of the cable's length stands still.
STANDS = 0.005
#: Tolerance for equal initial shapes of cables out of equilibrium, share of their length.
SAME_SHAPE = 0.05


def same_motion(first: Trial, second: Trial, length_m: float) -> bool:
    """Whether two trials repeat one gripper motion, up to its start position and time."""
    grips = first.grip, second.grip
    if first.start != second.start:
        return False
    if abs(grips[0].angle_rad[0] - grips[1].angle_rad[0]) > SAME_ANGLE_RAD:
        return False
    if first.start != "equilibrium" and not _begin_alike(first, second, length_m):
        return False
    reach_m = [float(np.abs(_way_m(grip, grip.t_s, length_m)).max()) for grip in grips]
    if max(reach_m) < STANDS * length_m:
        return True
    tolerance_m = SAME_WAY * max(reach_m)
    if abs(reach_m[0] - reach_m[1]) > tolerance_m:
        return False
    return _least_distance_m(*grips, length_m) <= tolerance_m


def _way_m(grip: Motion, t_s: FloatArray, length_m: float) -> FloatArray:
    """(times, 3) way and turn of a gripper from its start; it is at rest before and after."""
    columns = (grip.x_m, grip.y_m, length_m * grip.angle_rad)
    return np.column_stack([np.interp(t_s, grip.t_s, v) - v[0] for v in columns])


def _least_distance_m(first: Motion, second: Motion, length_m: float) -> float:
    """Largest distance of two ways at the shift of clocks with the best agreement of speeds."""
    step_s = max(float(np.median(np.diff(grip.t_s))) for grip in (first, second))
    times = [np.arange(grip.t_s[0], grip.t_s[-1], step_s) for grip in (first, second)]
    speeds = [
        np.diff(_way_m(grip, t_s, length_m), axis=0)
        for grip, t_s in zip((first, second), times, strict=True)
    ]
    size = next_fast_len(sum(map(len, speeds)))
    spectra = [rfft(v, size, axis=0) for v in speeds]
    alike = irfft(np.sum(spectra[0] * np.conj(spectra[1]), axis=1), size)
    lag = int(np.argmax(alike))
    lag -= size if lag >= len(speeds[0]) else 0
    late_s = times[0][0] - times[1][0] + lag * step_s
    distances = []
    for shift_s in late_s + np.linspace(-1.0, 1.0, 9) * step_s:
        t_s = np.union1d(times[0], times[1] + shift_s)
        away = _way_m(first, t_s, length_m) - _way_m(second, t_s - shift_s, length_m)
        distances.append(float(np.linalg.norm(away - np.median(away, axis=0), axis=1).max()))
    return min(distances)


def _begin_alike(first: Trial, second: Trial, length_m: float) -> bool:
    """Whether the cables of two trials begin in the same shape, as far as it is visible."""
    shapes = []
    for trial in (first, second):
        xy_m = trial.markers.xy_m
        row = int(np.argmax(np.isfinite(xy_m).any(axis=(1, 2))))
        shapes.append(xy_m[row] - [trial.grip.x_m[0], trial.grip.y_m[0]])
    if shapes[0].shape != shapes[1].shape:
        return False
    away_m = np.abs(shapes[0] - shapes[1])
    return not np.any(away_m > SAME_SHAPE * length_m)
