"""A recording identified again by a worker, compared with what was identified then."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from tempfile import TemporaryDirectory
from typing import Any, Literal

from cell.files.input_error import InputError
from cell.identify.identified import Identified
from cell.lab.line.identify_again import (
    RecordedCable,
    Rejected,
    identify_again,
    study_to_identify,
)
from cell.lab.line.recordings import Packed

#: Half the width of a 95 % interval, in standard deviations.
_REACH = NormalDist().inv_cdf(0.975)

Outcome = Literal["identified", "rejected", "failed"]
#: Values compared with those of then: bit for bit the same; within the 95 % intervals of then; some
#: outside; another model; identified then and not now; nothing to compare with.
Compared = Literal["same", "within", "outside", "other model", "lost", "nothing"]


@dataclass(frozen=True)
class IdentifiedAgain:
    """The result of one recording.

    key         hash of all that it depends on
    moved       parameter that has moved most from what was identified then; empty = none
    moved_std   by how many standard deviations of then
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
    if recording.wrong:
        return IdentifiedAgain(recording.name, recording.key, "failed", why=recording.wrong)
    then = _then(recording.then)
    without: Compared = "nothing" if then is None else "lost"
    with TemporaryDirectory() as place:
        folder = Path(place) / "cycle"
        for path, content in recording.files:
            file = folder / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        try:
            study = study_to_identify(folder)
            found = identify_again(RecordedCable(folder, study, recording.options))
        except (InputError, ValueError) as error:
            why = str(error).replace(str(folder), recording.name)
            return IdentifiedAgain(recording.name, recording.key, "failed", without, why=why)
    if isinstance(found, Rejected):
        key = recording.key
        return IdentifiedAgain(recording.name, key, "rejected", without, why=found.reason)
    return _row(recording, found, then)


def _row(recording: Packed, found: Identified, then: Mapping[str, Any] | None) -> IdentifiedAgain:
    now = {p["name"]: (p["value"], p["low"], p["high"]) for p in found.to_dict()["parameters"]}
    compared, moved, moved_std = _compared(now, then)
    return IdentifiedAgain(
        recording.name,
        recording.key,
        "identified",
        compared,
        moved,
        moved_std,
        found.residual_rms_m,
        found.noise.std_m,
        found.frames_used,
        found.frames_total,
        now,
    )


def _then(content: bytes | None) -> Mapping[str, tuple[float, float, float]] | None:
    """Parameters of model.json; None = there was none, or it cannot be read."""
    try:
        said = json.loads(content or b"null")
        return None if said is None else {
            p["name"]: (float(p["value"]), float(p["low"]), float(p["high"]))
            for p in said["parameters"]
        }  # fmt: skip
    except (ValueError, KeyError, TypeError):
        return None


def _compared(
    now: Mapping[str, tuple[float, float, float]],
    then: Mapping[str, tuple[float, float, float]] | None,
) -> tuple[Compared, str, float | None]:
    """How the values differ from then, which of them most, and by how many deviations of then."""
    if then is None:
        return "nothing", "", None
    if list(now) != list(then):
        return "other model", "", None
    if now == then:
        return "same", "", None
    moved = {
        name: abs(now[name][0] - value) / (0.5 * (high - low) / _REACH)
        for name, (value, low, high) in then.items()
        if high > low
    }
    most = max(moved, key=lambda name: moved[name], default="")
    inside = all(low <= now[name][0] <= high for name, (_, low, high) in then.items())
    return "within" if inside else "outside", most, moved.get(most)
