"""Recorded cables identified again from their studies alone: one, or each recording of a folder."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from tempfile import TemporaryDirectory
from typing import Literal

from cell.files.input_error import InputError
from cell.identify.identified import Identified
from cell.identify.individual import (
    CableRejectedError,
    IdentifyOptions,
    identify,
    with_effects,
)
from cell.lab.data.named_effects import select_effects
from cell.records.recording.reading import read_recording
from cell.records.recording.unpack import unpack
from cell.settings import load_settings
from cell.settings.translate import identification_of
from cell.study.clocks import with_pull
from cell.study.data import Study
from cell.study.folder import read_study, study_folder
from cell.study.left_out import without_outliers
from cell.workers.identity import code_hash

_RECORDING = ".mcap"
#: Digits of a hash that distinguish a year's recordings.
_DIGITS = 16


def study_to_identify(folder: Path) -> Study:
    """The study of a cycle's folder, or any study, as a cable is identified from it.

    raises  InputError: it cannot be read, or no trial is to be fitted
    """
    study = read_study(study_folder(folder))
    if study_folder(folder) == folder:  # the cell films the offset across the cable only
        study = without_outliers(study)
    if not study.role("fit"):
        message = "no trial has `role: fit`; mark the one to identify the cable from"
        raise InputError.at(folder, message, key="trials")
    try:
        return with_pull(study)
    except ValueError as error:
        raise InputError.at(folder, str(error), key="gravity_m_per_s2") from error


def options_with(settings: Path | None, effects: Sequence[str]) -> IdentifyOptions:
    """Options of identification by a settings file, with further effects in the model.

    settings  None = the baseline
    raises    InputError; ValueError as `select_effects`
    """
    in_model = select_effects(effects).in_model
    options = IdentifyOptions()
    if settings is not None:
        options = identification_of(load_settings(settings))
    return with_effects(options, in_model)


def recorded_settings(folder: Path) -> Path | None:
    """Path of the settings of a cycle; None if the folder is not that of a cycle."""
    return folder / "settings.yaml" if (folder / "state.json").exists() else None


def identify_again(study: Study, options: IdentifyOptions) -> Identified:
    """The cable, identified from its first trial with role `fit`.  Raises CableRejectedError."""
    return identify(
        study.role("fit")[0],
        study.arc_length_m,
        study.cable,
        gravity_m_per_s2=study.gravity_m_per_s2,
        pull_m_per_s2=study.pull_m_per_s2,
        options=options,
    )


@dataclass(frozen=True)
class Packed:
    """The files and options of one recording, as sent to a worker.

    name     path below the folder of the recordings
    key      hash of all that its result depends on, the program's code included
    files    of its study: path below the cycle's folder, or the study's, and content
    options  of its identification
    model    content of the cycle's model.json; None = there was none
    error    why it cannot be identified; empty = it can be tried
    """

    name: str
    key: str = ""
    files: tuple[tuple[str, bytes], ...] = ()
    options: IdentifyOptions = IdentifyOptions()  # noqa: RUF009
    model: bytes | None = None
    error: str = ""


def recordings_in(folder: Path) -> list[Path]:
    """Folders of cycles with measurements, studies, and recordings apart from their folder.

    In the order of their paths, which is that of time in a folder of cycles.
    raises  InputError: there is none
    """
    recordings = sorted(_recordings(folder)) if folder.is_dir() else []
    if not recordings:
        message = "holds no recorded cycle, no recording (.mcap) and no study"
        raise InputError.at(folder, f"{message}; give the folder that `cell run --runs` wrote to")
    return recordings


def _recordings(folder: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        path = Path(place)
        if "study.yaml" in files or (path / "study" / "study.yaml").exists():
            folders.clear()
            yield path
        else:
            yield from (path / name for name in files if name.endswith(_RECORDING))


def packer(folder: Path, config: Path | None, effects: Sequence[str]) -> Callable[[Path], Packed]:
    """Function that reads a recording below a folder into a `Packed`.

    config   settings for all; None = as recorded with each cycle, or the baseline
    effects  part of the model too, by name or file
    raises   InputError, ValueError: of these two, which are read at once
    """
    default = options_with(config, effects)
    cached: dict[bytes, IdentifyOptions] = {}

    def options_of(cycle: Path) -> IdentifyOptions:
        """Read once for all recordings with the same settings."""
        settings = recorded_settings(cycle)
        if config is not None or settings is None or not settings.exists():
            return default
        text = settings.read_bytes()
        if text not in cached:
            cached.clear()  # settings of a line change rarely
            cached[text] = options_with(settings, effects)
        return cached[text]

    def pack(recording: Path) -> Packed:
        name = recording.relative_to(folder).as_posix()
        try:
            if recording.suffix != _RECORDING or recording.is_dir():
                return _packed(name, recording, options_of)
            with TemporaryDirectory() as unpacked:
                cycle = unpack(read_recording(recording), Path(unpacked))
                return _packed(name, cycle, options_of)
        except (ValueError, OSError) as error:  # InputError, EffectError among them
            return Packed(name, error=str(error))

    return pack


def _packed(name: str, folder: Path, options_of: Callable[[Path], IdentifyOptions]) -> Packed:
    files = [
        (path.relative_to(folder).as_posix(), path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".yaml", ".csv")
        and path.is_file()
        and ((folder / "study.yaml").exists() or (folder / "study") in path.parents)
    ]
    options = options_of(folder)
    file = folder / "model.json"
    model = file.read_bytes() if file.exists() else None
    return Packed(name, _key(files, options, model), tuple(files), options, model)


def _key(files: Sequence[tuple[str, bytes]], options: IdentifyOptions, model: bytes | None) -> str:
    """Hash of what a result depends on."""
    effects = options.kind.effects
    plain = replace(options, kind=replace(options.kind, effects=()))
    own = [(e.name, "" if e.file is None else e.file.sha256) for e in effects]
    digest = hashlib.sha256(f"{code_hash()}\0{plain}\0{own}".encode())
    for path, content in [*files, ("model.json", model or b"")]:
        digest.update(f"{path}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:_DIGITS]


#: Half the width of a 95 % interval, in standard deviations.
_REACH = NormalDist().inv_cdf(0.975)

Outcome = Literal["identified", "rejected", "failed"]
#: Comparison with the earlier result: identical; within its 95 % intervals; some outside; other
#: parameters; identified earlier but not now; no earlier result.
Compared = Literal["same", "within", "outside", "other model", "lost", "nothing"]


@dataclass(frozen=True)
class IdentifiedAgain:
    """The result of one recording.

    key         hash of all that it depends on
    moved       parameter with the largest change from the earlier result; empty = none
    moved_std   its change in standard deviations of the earlier result
    parameters  name → value, and its 95 % interval
    why         it was rejected, or has failed
    """

    recording: str
    key: str
    outcome: Outcome
    compared: Compared = "nothing"
    moved: str = ""
    moved_std: float | None = None
    residual_rms_m: float | None = None
    noise_std_m: float | None = None
    frames_used: int | None = None
    frames_total: int | None = None
    parameters: Mapping[str, tuple[float, float, float]] | None = None
    why: str = ""


def identified_again(recording: Packed) -> IdentifiedAgain:
    """The cable of a recording, identified from its study alone."""
    row = IdentifiedAgain(recording.name, recording.key, "failed")
    if recording.error:
        return replace(row, why=recording.error)
    earlier = _parameters_of(recording.model)
    row = replace(row, compared="nothing" if earlier is None else "lost")
    with TemporaryDirectory() as place:
        folder = Path(place) / "cycle"
        for path, content in recording.files:
            file = folder / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        try:
            identified = identify_again(study_to_identify(folder), recording.options)
        except CableRejectedError as error:
            return replace(row, outcome="rejected", why=str(error))
        except (InputError, ValueError) as error:
            return replace(row, why=str(error).replace(str(folder), recording.name))
    now = {p["name"]: (p["value"], p["low"], p["high"]) for p in identified.to_dict()["parameters"]}
    compared, moved, moved_std = _compared(now, earlier)
    return replace(
        row,
        outcome="identified",
        compared=compared,
        moved=moved,
        moved_std=moved_std,
        residual_rms_m=identified.residual_rms_m,
        noise_std_m=identified.noise.std_m,
        frames_used=identified.frames_used,
        frames_total=identified.frames_total,
        parameters=now,
    )


def _parameters_of(model: bytes | None) -> Mapping[str, tuple[float, float, float]] | None:
    """Parameters in the content of model.json; None = there was none, or it cannot be read."""
    try:
        content = json.loads(model or b"null")
        return None if content is None else {
            p["name"]: (float(p["value"]), float(p["low"]), float(p["high"]))
            for p in content["parameters"]
        }  # fmt: skip
    except (ValueError, KeyError, TypeError):
        return None


def _compared(
    now: Mapping[str, tuple[float, float, float]],
    earlier: Mapping[str, tuple[float, float, float]] | None,
) -> tuple[Compared, str, float | None]:
    """Comparison with earlier values, the parameter that changed most, its change in std."""
    if earlier is None:
        return "nothing", "", None
    if list(now) != list(earlier):
        return "other model", "", None
    if now == earlier:
        return "same", "", None
    changes = {
        name: abs(now[name][0] - value) / (0.5 * (high - low) / _REACH)
        for name, (value, low, high) in earlier.items()
        if high > low
    }
    largest = max(changes, key=lambda name: changes[name], default="")
    inside = all(low <= now[name][0] <= high for name, (_, low, high) in earlier.items())
    return "within" if inside else "outside", largest, changes.get(largest)
