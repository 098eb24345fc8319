"""What a command does with a study: checked, made ready, fitted."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.cable.effects import Effect, library, load_effect
from cell.files.located import InputError, Problem
from cell.identify.identified import Identified
from cell.identify.noise import Noise, still_frames
from cell.identify.parameters import ParameterSpace
from cell.lab.explore import Candidate, Explorer, Progress
from cell.lab.fitting import pinned, space_with
from cell.lab.individual import (
    check_same_kind,
    identified,
    misfit,
    prior_space,
    read_model,
)
from cell.lab.prepared import ERRS, PreparedStudy
from cell.study.data import Study, Trial
from cell.study.folder import read_study

#: A uniform clamped strip that droops by δ swings at ω² = 1.545 g/δ (β₁L = 1.8751).
SWING = 1.545


@dataclass(frozen=True)
class Chosen:
    """Effects named on the command line: the library's by name, a user's own from files."""

    named: tuple[type[Effect], ...]
    own: tuple[type[Effect], ...]

    @property
    def library(self) -> dict[str, type[Effect]]:
        """All effects to choose from."""
        return library() | {e.name: e for e in self.own}


def choose_effects(names: Sequence[str]) -> Chosen:
    """Effects of a command line.  Raises InputError, EffectError, FileNotFoundError."""
    known = library()
    named, own = [], []
    for name in names:
        if name.endswith(".py"):
            own.append(load_effect(name))
        elif name in known:
            named.append(known[name])
        else:
            close = difflib.get_close_matches(name, known, 1, 0.5)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
            raise ValueError(f"--effect {name}: no such effect; {hint}")
    return Chosen(tuple(named), tuple(own))


def open_study(folder: Path) -> Study:
    """A study fit for the lab.

    raises  InputError: it cannot be read, has nothing to fit, or a trial is too short to tell
    """
    study = read_study(folder)
    problems = [
        Problem(folder / t.name / "markers.csv", len(t.markers.t_s) + 1, None, "t_s", message)
        for t in study.trials
        if (message := _too_short(study, t))
    ]
    if not study.role("fit"):
        message = "no trial has `role: fit`; mark at least one, the model is fitted to these"
        problems.append(Problem(folder / "study.yaml", 1, None, "trials", message))
    if problems:
        raise InputError(problems)
    return study


def _too_short(study: Study, trial: Trial) -> str | None:
    t_s = trial.markers.t_s
    still = still_frames(t_s, trial.grip, trial.release_s)
    moving_s = float(t_s[-1] - t_s[min(still.stop, len(t_s) - 1)])
    markers = trial.markers.xy_m[:, 0]
    rest = markers[still] if trial.start == "equilibrium" else markers[len(markers) // 2 :]
    droop_m = abs(float(np.nanmean(rest[:, 1] - trial.grip.y_m[0]))) if len(rest) else np.nan
    if not np.isfinite(droop_m):
        return None
    period_s = 2.0 * np.pi * np.sqrt(droop_m / (SWING * np.hypot(*study.gravity_m_per_s2)))
    if moving_s >= period_s:
        return None
    return (
        f"ends {moving_s:.3f} s after the motion begins, one swing of this cable takes about "
        f"{period_s:.2f} s; record longer or remove the trial"
    )


def explorer_of(
    study: Study,
    chosen: Chosen,
    prior: tuple[Path, Identified] | None = None,
    progress: Progress = lambda _: None,
) -> Explorer:
    """The study made ready, with an earlier individual's model as prior if there is one."""
    if prior is None:
        prepared, believed = PreparedStudy.of(study), None
        space = ParameterSpace.of(study.cable, gravity_m_per_s2=study.gravity_m_per_s2)
    else:
        path, model = prior
        check_same_kind(path, model, study.cable)
        space = prior_space(study, model)
        believed = space.mean
        prepared = PreparedStudy.of(
            study, misfit=misfit(model, _least_rms_m(study, space, model, chosen))
        )
    effects = [*space.effects, *(e for e in chosen.named if e not in space.effects)]
    return Explorer(prepared, space_with(space, effects), chosen.library, progress, believed)


def _least_rms_m(study: Study, space: ParameterSpace, model: Identified, chosen: Chosen) -> float:
    """Error of the earlier individual's model with whichever single effect helps it most, m.

    What even that leaves is the model's own error on this study; were it taken for information,
    the cable's parameters would be bent to remove it.
    """
    prepared = PreparedStudy.of(study, misfit=misfit(model))
    pilot = Explorer(prepared, pinned(space, space.mean), chosen.library)
    base = pilot.baseline()
    smooth = [e for e in chosen.library.values() if e.smooth and e not in space.effects]
    tried = pilot.add(base, smooth)
    return min([base.fit.rms_m, *(c.fit.rms_m for c in tried)])


def read_prior(path: Path | None) -> tuple[Path, Identified] | None:
    """The model that `--prior` names."""
    return None if path is None else (path, read_model(path, library()))


def fit_study(explorer: Explorer) -> tuple[Identified, Candidate]:
    """The best model of a study with the effects of the explorer's space.

    Where the model errs by more than the camera, its own error is taken for noise and the fit
    repeated, so that the prior keeps a part in what the data then cannot tell.  Its correlation
    widens the intervals and leaves the weight of the frames as it is.
    """
    candidate = explorer.baseline()
    prepared = explorer.prepared
    if candidate.fit.rms_m <= ERRS * prepared.noise.std_m:
        return identified(prepared, candidate.fit), candidate
    left = Noise(candidate.fit.rms_m)
    coarser = Explorer(
        PreparedStudy.of(prepared.study, misfit=left, solver=prepared.solver),
        explorer.space,
        explorer.library,
    )
    candidate = coarser.baseline()
    return identified(coarser.prepared, candidate.fit), candidate
