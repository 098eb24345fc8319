"""Set-up of a command: its study's fits, with an earlier model as prior, and without outliers.

Outliers that the measurements alone do not reveal, for few frames per second or little noise, show
in the residual of a fitted model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects import Effect
from cell.cable.geometry import Cable
from cell.identify.identified import Identified
from cell.identify.model_class import ModelClass
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import EffectSelection, select_effects
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.data.work import DIAGNOSIS, Progress, Work, no_progress
from cell.lab.fit.fitting import pinned, space_with
from cell.lab.fit.individual_model import check_same_kind, misfit, prior_space, read_model
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import residuals_m
from cell.study.data import Study
from cell.study.left_out import without_samples
from cell.study.sample_outliers import outlier_distances

#: Most rounds of outlier removal: outliers that had distorted the fit hide others.
_MOST_ROUNDS = 3


def fit_cache_of(
    study: Study,
    selection: EffectSelection,
    prior: tuple[Path, Identified] | None = None,
    progress: Progress = no_progress,
    kind: ModelClass = ModelClass(),  # noqa: B008
    work: Work | None = None,
) -> FitCache:
    """The fit cache of a study, optionally with an earlier individual's model as prior.

    The model contains the prior's effects and the effects selected for it.
    kind  parameters common to all such cables; an individual's prior has its own
    work  budget of the study; None = that of a diagnosis
    """
    work = Work(DIAGNOSIS) if work is None else work
    if prior is None:
        prepared = PreparedStudy.of(study, work=work)
        space = kind.space(study.cable, study.gravity_m_per_s2, study.pull_m_per_s2)
    else:
        path, model = prior
        check_same_kind(path, model, study.cable)
        space = prior_space(study, model)
        noise: Noise | None = None  # stays None if the model was never fitted
        if model.frames_used:
            noise = misfit(model, _least_rms_m(study, space, model, selection.candidates, work))
        prepared = PreparedStudy.of(study, misfit=noise, work=work)
    unknown = tuple(e for e in selection.in_model if e not in space.effects)
    level_mm = prepared.noise_model.noise.std_m * 1e3
    work.known = f"no model is fitted yet; noise of study {study.name}: {level_mm:.3g} mm"
    full = space_with(space, [*space.effects, *unknown])
    prior_q = None if prior is None else full.mean
    return FitCache.of(
        SearchSetup(
            prepared, full, selection.candidates, progress, prior_q=prior_q, unknown_effects=unknown
        )
    )


def read_kind(config: Path | None) -> ModelClass:
    """The `ModelClass` of the section `model` in a cell's settings; the baseline without one.

    raises  InputError
    """
    if config is None:
        return ModelClass()
    from cell.settings import load_settings  # takes 0.2 s, rarely needed
    from cell.settings.translate import model_class_of

    return model_class_of(load_settings(config).model)


def _least_rms_m(
    study: Study,
    space: ParameterSpace,
    model: Identified,
    candidates: Mapping[str, type[Effect]],
    work: Work,
) -> float:
    """Error of the earlier individual's model with the best single effect added, m.

    That is the model's own error on this study; without allowing for it, the cable's parameters
    would be distorted to remove it.
    """
    prepared = PreparedStudy.of(study, misfit=misfit(model), work=work)
    pilot = FitCache.of(SearchSetup(prepared, pinned(space, space.mean), candidates))
    base = pilot.base
    smooth = [e for e in candidates.values() if e.smooth and e not in space.effects]
    extended = pilot.fit_extended(base, smooth)
    return min([base.fit.rms_m, *(c.fit.rms_m for c in extended)])


def read_prior(
    path: Path | None, own: Mapping[str, type[Effect]]
) -> tuple[Path, Identified] | None:
    """The model in the file of `--prior`; effects in `own` replace those of its own files."""
    return None if path is None else (path, read_model(path, own))


def read_models(paths: Sequence[Path], cable: Cable, own: Sequence[str]) -> list[Identified]:
    """Models of a kind of cable.

    own     files of their own effects, if not where the models say
    raises  InputError: a model cannot be read or is of another kind of cable; ValueError: no model
            has one of the effects; EffectError; FileNotFoundError
    """
    selections = {name: select_effects([name]) for name in own}
    effects = {n: e for selection in selections.values() for n, e in selection.own.items()}
    models = [read_model(path, effects) for path in paths]
    for path, model in zip(paths, models, strict=True):
        check_same_kind(path, model, cable)
    used = {e.name for m in models for e in m.space.effects}
    for name, selection in selections.items():
        if selection.in_model[0].name not in used:
            raise ValueError(
                f"--with {name}: is not in {' or '.join(map(str, paths))}; "
                f"fit a model with it: cell fit STUDY --with {name} -o model.json"
            )
    return models


def without_outliers(fits: FitCache) -> tuple[FitCache, tuple[str, ...]]:
    """The fits of a study without its outliers, by the baseline's residual, and a note on each.

    A trial that the model cannot simulate is not changed.
    raises  InputError: too many samples of a marker are outliers
    """
    notes: tuple[str, ...] = ()
    for _ in range(_MOST_ROUNDS):
        distances, study = _outliers(fits), as_measured(fits.prepared)
        if not any(np.isfinite(d).any() for d in distances):
            break
        cleaner = without_samples(study, distances)
        notes = (*notes, *cleaner.notes[len(study.notes) :])
        former = fits.prepared
        noise = None if former.noise_is_measured else former.noise
        prepared = PreparedStudy.of(cleaner, misfit=noise, solver=former.solver, work=former.work)
        fits = FitCache.of(replace(fits.setup, prepared=prepared))
    return fits, notes


def _outliers(fits: FitCache) -> list[FloatArray]:
    """Per trial (times, channels) distance of outliers, m; nan for all other samples."""
    prepared, distances = fits.prepared, []
    residuals = residuals_m(prepared, fits.base)
    for trial, joined in zip(prepared.unjoined.trials, prepared.study.trials, strict=True):
        markers, residual = trial.markers, residuals.get(trial.name)
        if residual is None or not np.isfinite(residual).any():
            distances.append(np.full((len(markers.t_s), markers.xy_m[0].size), np.nan))
            continue
        errors = prepared.of_markers(joined, residual.reshape(joined.markers.xy_m.shape))
        distances.append(outlier_distances(markers.t_s, errors.reshape(len(markers.t_s), -1)))
    return distances
