"""What a command does with a study: checked, made ready, fitted."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cell.cable.effects import Effect, library
from cell.cable.geometry import Cable, Motion
from cell.files.input_error import InputError, Problem
from cell.identify.identified import Identified
from cell.identify.model_class import ModelClass, effect_from, known_effects
from cell.identify.noise import Noise, still_frames
from cell.identify.parameters import ParameterSpace
from cell.lab.explore import Candidate, Explorer, Progress, no_progress
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
from cell.study.folder import read_study, study_folder
from cell.study.left_out import without_wrong_samples

_LOG = logging.getLogger(__name__)

#: A uniform clamped strip that droops by δ swings at ω² = 1.545 g/δ (β₁L = 1.8751).
SWING = 1.545
#: No camera sees so little motion, noise included: positions that were not measured, m.
STANDS_M = 1e-6
#: Wrong values of a hand's log that are told of a column.
TOLD = 3


@dataclass(frozen=True)
class EffectSelection:
    """Effects of a command line.

    in_model    part of the model from the start
    candidates  by name: those that may be found missing, the library's included
    """

    in_model: tuple[type[Effect], ...]
    candidates: dict[str, type[Effect]]

    @property
    def own(self) -> dict[str, type[Effect]]:
        """A user's own effects by name, from files."""
        given = (*self.in_model, *self.candidates.values())
        return {e.name: e for e in given if e.file is not None}


def select_effects(in_model: Sequence[str], candidates: Sequence[str] = ()) -> EffectSelection:
    """Effects by name, or from a user's own files (`….py`); candidates join the library.

    raises  ValueError: unknown, given twice, or of a library effect's name; EffectError;
            FileNotFoundError
    """
    effects: dict[str, type[Effect]] = {}
    for given in (*in_model, *candidates):
        effect = _effect(given)
        if effect.name in effects:
            raise ValueError(
                f"--effect {given}: another effect {effect.name!r} is given too; leave one out, "
                "or rename one (`name = …` in its file)"
            )
        effects[effect.name] = effect
    chosen = list(effects.values())
    more = {e.name: e for e in chosen[len(in_model) :]}
    return EffectSelection(tuple(chosen[: len(in_model)]), library() | more)


def select_for_diagnosis(effects: Sequence[str], known: Sequence[str]) -> EffectSelection:
    """The same for a command that looks for what is missing.

    effects  one that is tried anyway is part of the model; any other joins those tried
    known    part of the model
    """
    tried_anyway = library()
    in_model = [*known, *(e for e in effects if e in tried_anyway)]
    return select_effects(in_model, [e for e in effects if e not in tried_anyway])


def _effect(given: str) -> type[Effect]:
    known = known_effects()
    if given.endswith(".py"):
        effect = effect_from(given)
        if effect.name in library():
            raise ValueError(
                f"--effect {given}: its name {effect.name!r} is that of an effect of the library; "
                "rename it (`name = …` in the file)"
            )
        return effect
    if given not in known:
        close = difflib.get_close_matches(given, known, 1, 0.5)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
        raise ValueError(f"--effect {given}: no such effect; {hint}; your own as its file.py")
    return known[given]


def open_study(folder: Path) -> Study:
    """A study fit for the lab, by its folder or by that of the cycle that recorded it.

    raises  InputError: it cannot be read, has nothing to fit, a trial is too short to tell, or too
            much of a marker is wrong
    """
    given, folder = folder, study_folder(folder)
    study = replace(read_study(folder), filmed=folder != given)
    problems = [
        Problem(folder / t.name / "markers.csv", len(t.markers.t_s) + 1, None, "t_s", message)
        for t in study.trials
        if (message := _stands(t) or _too_short(study, t))
    ]
    if not study.role("fit"):
        message = "no trial has `role: fit`; mark at least one, the model is fitted to these"
        problems.append(Problem(folder / "study.yaml", 1, None, "trials", message))
    if problems:
        raise InputError(problems)
    told = [note for t in study.trials for note in _left_out(folder / t.name / "grip.csv", t.grip)]
    return without_wrong_samples(replace(study, notes=(*study.notes, *told)))


def _left_out(log: Path, grip: Motion) -> list[str]:
    """Of every column of a hand's log, what values are no motion: how many, where, how large."""
    notes = []
    splines = dict(zip(("x_m", "y_m", "angle_rad"), grip.splines, strict=True))
    for column, spline in splines.items():
        apart = {i: float(getattr(grip, column)[i] - spline.value[i]) for i in spline.wrong}
        largest = sorted(apart, key=lambda i: -abs(apart[i]))[:TOLD]
        if not largest:
            continue
        unit = "mrad" if column == "angle_rad" else "mm"
        shown = [f"line {i + 2} by {apart[i] * 1e3:+.2g} {unit}" for i in largest]
        more = f" and {len(apart) - TOLD} more" if len(apart) > TOLD else ""
        notes.append(
            f"{log}: {column} jumps for a sample or two, which no hand does: {', '.join(shown)}"
            f"{more}; left out"
        )
    return notes


def _stands(trial: Trial) -> str | None:
    """That markers do not move at all; a camera's noise would be more."""
    xy_m = trial.markers.xy_m
    seen = np.isfinite(xy_m).any(axis=0)
    if np.any(np.nanmax(xy_m[:, seen], axis=0) - np.nanmin(xy_m[:, seen], axis=0) > STANDS_M):
        return None
    return (
        f"is the last of {len(xy_m)} rows in which no marker moves by {STANDS_M * 1e3:g} mm: "
        "record a motion, with all digits, or remove the trial"
    )


def _too_short(study: Study, trial: Trial) -> str | None:
    t_s = trial.markers.t_s
    still = still_frames(t_s, trial.grip, trial.rests_until_s)
    moving_s = float(t_s[-1] - t_s[min(still.stop, len(t_s) - 1)])
    markers = trial.markers.xy_m[:, 0]
    rest = markers[still] if trial.start == "equilibrium" else markers[len(markers) // 2 :]
    beside_m = rest[:, 1] - trial.grip.y_m[0]
    gravity_m_per_s2 = float(np.hypot(*study.gravity_m_per_s2))
    if not np.isfinite(beside_m).any() or gravity_m_per_s2 == 0.0:
        return None
    droop_m = abs(float(np.nanmean(beside_m)))
    period_s = 2.0 * np.pi * np.sqrt(droop_m / (SWING * gravity_m_per_s2))
    if moving_s >= period_s:
        return None
    return (
        f"ends {moving_s:.3f} s after the motion begins, one swing of this cable takes about "
        f"{period_s:.2f} s; record longer or remove the trial"
    )


def explorer_of(
    study: Study,
    selection: EffectSelection,
    prior: tuple[Path, Identified] | None = None,
    progress: Progress = no_progress,
    kind: ModelClass = ModelClass(),  # noqa: B008
) -> Explorer:
    """The study made ready, with an earlier individual's model as prior if there is one.

    The prior's effects are part of the model, and those of the selection that are.
    kind  what all such cables have in common; an individual's prior has its own
    """
    if prior is None:
        prepared = PreparedStudy.of(study)
        space = kind.space(study.cable, study.gravity_m_per_s2)
    else:
        path, model = prior
        check_same_kind(path, model, study.cable)
        space = prior_space(study, model)
        prepared = PreparedStudy.of(
            study, misfit=misfit(model, _least_rms_m(study, space, model, selection.candidates))
        )
    sought = tuple(e for e in selection.in_model if e not in space.effects)
    full = space_with(space, [*space.effects, *sought])
    prior_q = None if prior is None else full.mean
    return Explorer(prepared, full, selection.candidates, progress, prior_q=prior_q, sought=sought)


def read_kind(config: Path | None) -> ModelClass:
    """What the section `model` of a cell's settings says; the baseline without.

    raises  InputError
    """
    if config is None:
        return ModelClass()
    from cell.settings import load_settings  # a fifth of a second, which few have need of
    from cell.settings.translate import model_class_of

    return model_class_of(load_settings(config).model)


def _least_rms_m(
    study: Study,
    space: ParameterSpace,
    model: Identified,
    candidates: Mapping[str, type[Effect]],
) -> float:
    """Error of the earlier individual's model with whichever single effect helps it most, m.

    What even that leaves is the model's own error on this study; were it taken for information,
    the cable's parameters would be bent to remove it.
    """
    prepared = PreparedStudy.of(study, misfit=misfit(model))
    pilot = Explorer(prepared, pinned(space, space.mean), candidates)
    base = pilot.baseline()
    smooth = [e for e in candidates.values() if e.smooth and e not in space.effects]
    tried = pilot.add(base, smooth)
    return min([base.fit.rms_m, *(c.fit.rms_m for c in tried)])


def read_prior(
    path: Path | None, own: Mapping[str, type[Effect]]
) -> tuple[Path, Identified] | None:
    """The model that `--prior` names; `own` effects are given instead of its files'."""
    return None if path is None else (path, read_model(path, own))


def read_models(paths: Sequence[Path], cable: Cable, own: Sequence[str]) -> list[Identified]:
    """Models of a kind of cable.

    own     files of their own effects, if not where the models say
    raises  InputError: a model cannot be read or is of another kind of cable; ValueError: no model
            has one of the effects; EffectError; FileNotFoundError
    """
    given = {name: select_effects([name]) for name in own}
    effects = {n: e for selection in given.values() for n, e in selection.own.items()}
    models = [read_model(path, effects) for path in paths]
    for path, model in zip(paths, models, strict=True):
        check_same_kind(path, model, cable)
    used = {e.name for m in models for e in m.space.effects}
    for name, selection in given.items():
        if selection.in_model[0].name not in used:
            raise ValueError(
                f"--effect {name}: is not in {' or '.join(map(str, paths))}; "
                f"fit a model with it: cell fit STUDY --effect {name} -o model.json"
            )
    return models


def fit_study(explorer: Explorer) -> tuple[Identified, Candidate, PreparedStudy]:
    """The best model of a study with the effects of the explorer's space; the study as fitted to.

    Where the model errs by more than the camera, its own error is taken for noise and the fit
    repeated, so that the prior keeps a part in what the data then cannot tell.  Its correlation
    widens the intervals and leaves the weight of the frames as it is.
    """
    candidate = explorer.baseline()
    prepared = explorer.prepared
    _LOG.info("fitted %s: %.4f mm", prepared.study.name, candidate.fit.rms_m * 1e3)
    if candidate.fit.rms_m <= ERRS * prepared.expected.std_m:
        return identified(prepared, candidate.fit, explorer.library.values()), candidate, prepared
    left = Noise(candidate.fit.rms_m)
    coarser = Explorer(
        PreparedStudy.of(prepared.measured, misfit=left, solver=prepared.solver),
        explorer.space,
        explorer.library,
        explorer.progress,
        begin=candidate.fit.q if explorer.sought else None,
    )
    candidate = coarser.baseline()
    model = identified(coarser.prepared, candidate.fit, explorer.library.values())
    return model, candidate, coarser.prepared
