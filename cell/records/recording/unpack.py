"""Unpacks a recording to a folder like that of its cycle, without the pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable, Motion
from cell.files.input_error import InputError
from cell.files.words import error_text
from cell.files.yaml_document import yaml_text
from cell.records.folder import FORMAT
from cell.records.recording import form
from cell.records.recording.reading import Recording
from cell.study.data import Markers, Study, Trial, Wrench, WrenchSensor
from cell.study.folder import write_study
from cell.study.hand_drift import ENTRY, HandDrift
from cell.study.wrench import SensorEntry, sensor_entry


def study_to_plain(study: Study) -> dict[str, Any]:
    """A study as names, numbers and arrays, without notes and sources."""
    return {
        "name": study.name,
        "cable": study.cable.to_dict(),
        "arc_length_m": study.arc_length_m,
        "gravity_m_per_s2": list(study.gravity_m_per_s2),
        "noise_std_m": study.noise_std_m,
        "arc_length_std_m": None
        if study.arc_length_std_m is None
        else [float(s) for s in study.arc_length_std_m],
        "trials": [
            {
                "name": trial.name,
                "role": trial.role,
                "start": trial.start,
                "release_s": trial.release_s,
                "hand_drift": None if trial.hand_drift is None else trial.hand_drift.to_plain(),
                "grip": {k: getattr(trial.grip, k) for k in ("t_s", "x_m", "y_m", "angle_rad")},
                "markers": {"t_s": trial.markers.t_s, "xy_m": trial.markers.xy_m},
            }
            | ({} if trial.wrench is None else {"wrench": dict(vars(trial.wrench))})
            for trial in study.trials
        ],
    } | ({} if study.sensor == WrenchSensor() else {"wrench": sensor_entry(study.sensor)})


def study_from_plain(data: Mapping[str, Any]) -> Study:
    """The study of `study_to_plain`, directly or by way of JSON; None in arrays becomes nan.

    raises  KeyError, TypeError, ValueError: no study
    """
    x_m_per_s2, y_m_per_s2 = data["gravity_m_per_s2"]
    std_m = data.get("arc_length_std_m")  # recordings of earlier versions have none
    return Study(
        data["name"],
        Cable.from_dict(data["cable"]),
        _array(data["arc_length_m"]),
        tuple(
            Trial(
                t["name"],
                t["role"],
                t["start"],
                Motion(**{k: _array(v) for k, v in t["grip"].items()}),
                Markers(_array(t["markers"]["t_s"]), _array(t["markers"]["xy_m"])),
                t["release_s"],
                _drift(t.get("hand_drift")),
                Wrench(**{k: _array(v) for k, v in t["wrench"].items()}) if "wrench" in t else None,
            )
            for t in data["trials"]
        ),
        (float(x_m_per_s2), float(y_m_per_s2)),
        data["noise_std_m"],
        arc_length_std_m=None if std_m is None else _array(std_m),
        sensor=SensorEntry(**data.get("wrench", {})).sensor(),
    )


def _drift(section: Mapping[str, Any] | None) -> HandDrift | None:
    """Recordings of earlier versions have none."""
    return None if section is None else ENTRY.validate_python(section)


def _array(values: Any) -> FloatArray:
    return np.array(values, float)


def unpack(recording: Recording, into: Path) -> Path:
    """Write study, settings, model, state and result to a folder named as the cycle's was.

    raises  InputError: the recording does not name its cycle, or is damaged; OSError
    """
    about = recording.last(form.CYCLE)
    if about is None:
        raise InputError.at(recording.path, "ends before its cycle has begun: nothing is in it")
    folder = into / Path(about["folder"]).name
    folder.mkdir(parents=True)
    steps = [s["step"] for s in recording.json(form.STATE) if s["step"]]
    state = {
        "format": FORMAT,
        "cycle": about["cycle"],
        "closed": recording.complete,
        "step": steps[-1] if steps else None,
    }
    state |= {k: about[k] for k in ("started", "product") if about.get(k) is not None}
    _write(folder / "state.json", state)
    for topic, name in ((form.MODEL, "model.json"), (form.RESULT, "result.json")):
        if (data := recording.last(topic)) is not None:
            _write(folder / name, data)
    if recording.count(form.SETTINGS):
        settings = restored_files(recording, into / "files")
        (folder / "settings.yaml").write_text(yaml_text(settings), encoding="utf-8")
    if (data := recording.last(form.STUDY)) is not None:
        try:
            write_study(study_from_plain(data), folder / "study", recorded=True)
        except (KeyError, TypeError, ValueError) as error:
            message = f"{form.STUDY} is no study ({error_text(error)})"
            raise InputError.at(recording.path, message) from error
    return folder


def restored_files(recording: Recording, folder: Path) -> dict[str, Any]:
    """Settings as recorded, with the files that they refer to written into `folder`.

    raises  InputError: the recording holds no settings
    """
    message = recording.last(form.SETTINGS)
    if message is None:
        raise InputError.at(recording.path, "holds no settings; give some with --config")
    settings: dict[str, Any] = message["settings"]
    places = {}
    for number, (path, text) in enumerate(message["files"].items()):
        place = folder / f"{number}" / Path(path).name
        if Path(path).suffix == ".yaml":
            place = folder / "calibration" / Path(path).name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
        places[path] = str(place)
    if settings.get("calibration") is not None:
        settings["calibration"]["folder"] = str(folder / "calibration")
    for effect in settings["model"]["effects"]:
        effect["effect"] = places.get(effect["effect"], effect["effect"])
    return settings


def _write(path: Path, data: dict[str, Any]) -> None:
    path.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
