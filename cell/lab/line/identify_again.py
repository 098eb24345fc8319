"""A recorded cable identified again from its study alone, with the former or the present model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cell.files.input_error import InputError
from cell.identify.identified import Identified
from cell.identify.individual import (
    CableRejectedError,
    IdentifyOptions,
    identify,
    with_effects,
)
from cell.lab.data.named_effects import select_effects
from cell.settings import load_settings
from cell.settings.translate import identification_of
from cell.study.clocks import with_pull
from cell.study.data import Study
from cell.study.folder import read_study, study_folder
from cell.study.left_out import without_outliers


@dataclass(frozen=True, eq=False)
class RecordedCable:
    """A recorded cable: its study, and with which model it is to be identified."""

    folder: Path
    study: Study
    options: IdentifyOptions


@dataclass(frozen=True)
class Rejected:
    """A cable that cannot be identified, and why."""

    reason: str


def read_recorded(folder: Path, config: Path | None, effects: Sequence[str]) -> RecordedCable:
    """The cable of a cycle's folder, or of any study.

    config   settings whose `model` is used; None = as recorded with the cycle, or the baseline
    effects  part of the model besides, by name or file
    raises   InputError: it cannot be read, or no trial is to be fitted; ValueError as
             `select_effects`
    """
    study = study_to_identify(folder)
    recorded = (folder / "state.json").exists()
    settings = config or (folder / "settings.yaml" if recorded else None)
    return RecordedCable(folder, study, options_with(settings, effects))


def study_to_identify(folder: Path) -> Study:
    """The study of a cycle's folder, or any study, as a cable is identified from it.

    raises  InputError: it cannot be read, or no trial is to be fitted
    """
    study = read_study(study_folder(folder))
    if study_folder(folder) == folder:  # what the cell filmed is judged across the cable alone
        study = without_outliers(study)
    if not study.role("fit"):
        message = "no trial has `role: fit`; mark the one to identify the cable from"
        raise InputError.at(folder, message, key="trials")
    try:
        return with_pull(study)
    except ValueError as error:
        raise InputError.at(folder, str(error), key="gravity_m_per_s2") from error


def options_with(settings: Path | None, effects: Sequence[str]) -> IdentifyOptions:
    """How a cable is identified by settings, with effects more in the model.

    raises  InputError; ValueError as `select_effects`
    """
    in_model = select_effects(effects).in_model
    options = IdentifyOptions()
    if settings is not None:
        options = identification_of(load_settings(settings))
    return with_effects(options, in_model)


def identify_again(recorded: RecordedCable) -> Identified | Rejected:
    """The cable as its first trial with the role `fit` shows it."""
    study = recorded.study
    try:
        return identify(
            study.role("fit")[0],
            study.arc_length_m,
            study.cable,
            gravity_m_per_s2=study.gravity_m_per_s2,
            pull_m_per_s2=study.pull_m_per_s2,
            options=recorded.options,
        )
    except CableRejectedError as error:
        return Rejected(str(error))
