"""A cable's model as a file: read, checked, and used as the prior of another fit."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.effects import Effect, EffectFile, file_sha256
from cell.cable.effects.remote import confine_effects
from cell.cable.geometry import Cable
from cell.files.input_error import InputError
from cell.files.text_file import read_json_object
from cell.identify.identified import Identified
from cell.identify.model_class import effect_from, known_effects
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace, Prior
from cell.lab.fit.fitting import space_with
from cell.study.data import Study

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
