"""Makes of a recording the folder that its cycle had left, without the pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.files.yaml_document import yaml_text
from cell.records.folder import FORMAT
from cell.records.recording import form
from cell.records.recording.reading import Recording
from cell.study.folder import write_study
from cell.study.plain import study_from_plain


def unpack(recording: Recording, into: Path) -> Path:
    """Write study, settings, model, state and result to a folder named as the cycle's was.

    raises  InputError: the recording does not say of which cycle it is, or is damaged; OSError
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
        if (said := recording.last(topic)) is not None:
            _write(folder / name, said)
    if recording.count(form.SETTINGS):
        settings = restored_files(recording, into / "files")
        (folder / "settings.yaml").write_text(yaml_text(settings), encoding="utf-8")
    if (said := recording.last(form.STUDY)) is not None:
        try:
            write_study(study_from_plain(said), folder / "study", recorded=True)
        except (KeyError, TypeError, ValueError) as error:
            message = f"{form.STUDY} is no study ({type(error).__name__}: {error})"
            raise InputError.at(recording.path, message) from error
    return folder


def restored_files(recording: Recording, folder: Path) -> dict[str, Any]:
    """Settings as recorded, with the files that they refer to written into `folder`.

    raises  InputError: the recording holds no settings
    """
    said = recording.last(form.SETTINGS)
    if said is None:
        raise InputError.at(recording.path, "holds no settings; give some with --config")
    settings: dict[str, Any] = said["settings"]
    places = {}
    for number, (path, text) in enumerate(said["files"].items()):
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
