"""Set-up of a command: its study's fits, with an earlier model as prior, and without outliers.

Outliers that the measurements alone do not reveal, for few frames per second or little noise, show
in the residual of a fitted model.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects import Effect, EffectFile, file_sha256
from cell.cable.effects.remote import confine_effects
from cell.cable.geometry import Cable
from cell.files.input_error import InputError
from cell.files.text_file import read_json_object
from cell.identify.identified import Identified
from cell.identify.model_class import ModelClass, effect_from, known_effects
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace, Prior
from cell.lab.data.named_effects import EffectSelection, select_effects
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.data.work import DIAGNOSIS, Progress, Work, no_progress
from cell.lab.fit.fitting import pinned, space_with
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import residuals_m
from cell.study.data import Study
from cell.study.left_out import without_samples
from cell.study.sample_outliers import outlier_distances

#: Relative tolerance of the datasheets of one kind of cable.
SAME_CABLE = 0.01


def read_model(path: Path, own: Mapping[str, type[Effect]] | None = None) -> Identified:
    """The model in a file, with its effects.

    A user's own effects are loaded from the files that the model names, or next to the model.
    own     effects to use instead, by name; their files must be those used for the fit
    raises  InputError: the model cannot be read, or is something else, or an effect's file is
            missing or has changed; EffectError: that file
    """
    data = read_json_object(path)
    try:
        return Identified.from_dict(data, _effects(path, data, own or {}))
    except InputError:
        raise
    except ValueError as error:
        raise InputError.at(path, f"{error}; give a model as `cell fit -o` writes it") from error


def _effects(
    model: Path, data: Mapping[str, Any], own: Mapping[str, type[Effect]]
) -> dict[str, type[Effect]]:
    """The effects that a model's data name."""
    effects = dict(known_effects())
    files = data.get("effect_files", {})
    if not isinstance(files, dict):
        raise InputError.at(model, f"effect_files is {files!r}; fit the model again")
    for name, entry in files.items():
        if name not in data["effects"]:
            continue
        if not (isinstance(entry, dict) and {"path", "sha256"} <= entry.keys()):
            raise InputError.at(
                model, f"effect_files.{name} lacks path or sha256; fit the model again"
            )
        override = own.get(name)
        if override is None:
            file = _effect_file(model, name, entry)
            if entry.get("confined"):
                confine_effects(file)
            effects[name] = effect_from(str(file))
        elif override.file is None or override.file.sha256 != entry["sha256"]:
            raise _changed(model, name, entry, override.file)
        else:
            effects[name] = override
    return effects


def _effect_file(model: Path, name: str, entry: Mapping[str, str]) -> Path:
    """The unchanged file of a model's own effect: at its stated path, or next to the model."""
    stated = Path(entry["path"])
    present = [p for p in (stated, model.parent / stated.name) if p.is_file()]
    if not present:
        raise InputError.at(
            model,
            f"was fitted with the effect {name} of {stated}, SHA-256 {entry['sha256']}; this file "
            "is missing, also next to the model: put it back, or say with --with where it is, or "
            "fit the model again",
        )
    files = [EffectFile(p, file_sha256(p)) for p in present]
    for file in files:
        if file.sha256 == entry["sha256"]:
            return file.path
    raise _changed(model, name, entry, files[0])


def _changed(
    model: Path, name: str, entry: Mapping[str, str], file: EffectFile | None
) -> InputError:
    now = "the library's own" if file is None else f"{file.path}, SHA-256 {file.sha256}"
    again = name if file is None else shlex.quote(str(file.path))
    return InputError.at(
        model,
        f"was fitted with the effect {name} of {entry['path']}, SHA-256 {entry['sha256']}, but it "
        f"is now {now}: restore the file, or fit the model again: cell fit STUDY --with {again}",
    )


def check_same_kind(path: Path, model: Identified, cable: Cable) -> None:
    """Raise InputError if a model is of another kind of cable than the datasheet's."""
    for name, value in cable.numbers.items():
        fitted = model.space.cable.numbers[name]
        if abs(fitted - value) > SAME_CABLE * value:
            raise InputError.at(
                path,
                f"is of another cable: its {name} is {fitted:g}, the study's {value:g}; "
                "give a model of the same kind of cable",
            )


def prior_space(study: Study, model: Identified) -> ParameterSpace:
    """The study's parameters with an earlier individual's posterior as prior, with its effects."""
    space = ParameterSpace.of(
        study.cable,
        gravity_m_per_s2=study.gravity_m_per_s2,
        prior=Prior(knots=model.space.knots),
        pull_m_per_s2=study.pull_m_per_s2,
    )
    space = space_with(space, model.space.effects)
    precision = np.linalg.inv(model.covariance + 1e-12 * np.eye(len(model.mean)))
    return replace(space, mean=model.mean.copy(), precision=0.5 * (precision + precision.T))


def misfit(model: Identified, rms_m: float = 0.0) -> Noise:
    """The residual of an earlier individual's model, as noise of independent frames.

    The errors of a model are correlated over many frames.  Their lower information is expressed by
    a level raised by the root of the correlation time (`inflation` over the mean square).
    rms_m  error of the present study's best model, if that is larger
    """
    square = (model.residual_rms_m / model.noise.std_m) ** 2
    correlation_time = max(model.inflation / max(square, 1.0), 1.0)
    return Noise(max(model.residual_rms_m, rms_m) * float(np.sqrt(correlation_time)))


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
