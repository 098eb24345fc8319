"""Format of a recording: its topics, their schemas, and the encoding of times and angles.

Frames, poses, log and overlay have the standard schemas of Foxglove, which viewers draw.  JSON
messages hold the same numbers unrounded, from which a replay computes.

  /camera/image    RawImage          a frame, mono8; its exact time is in /camera/frame
  /camera/frame    JSON              index, t_s; blank: pixels of this grey level show the earlier
                                     picture
  /camera/seen     ImageAnnotations  the detected cable
  /arm/measured    PoseInFrame       at the arm's own rate, in the cell's plane
  /arm/commanded   PoseInFrame       every commanded path of the arm
  /arm/path        JSON              the same path: start_s, t_s, x_m, y_m, angle_rad
  /arm/answer      JSON              measured poses as the arm reported them to the cell
  /arm/state       JSON              mode of the arm, when it changes
  /gripper         JSON              command and answer
  /cell/...        JSON              cycle, state, settings, decision, model, study, fault, result
  /recording/gap   JSON              frames that are missing here, and why
  /log             Log               log of the program
"""

from __future__ import annotations

import math
from typing import Any, Final

FORMAT: Final = "cable-recording/1"
#: Name of a metadata record at the beginning, and of the one that marks a complete file.
BEGUN, CLOSED = "cable-recording", "cable-recording-closed"

#: Entry of the first: file in memory with messages that a killed recorder has not written.
RING = "ring"
#: Entry of the second: bytes of the torn file that could not be recovered.
DAMAGED_BYTES = "damaged_bytes"
#: Entry of the first: offset of the cell's clock, nanoseconds since 1970.
EPOCH = "epoch_ns"

#: File of a recording in its cycle's folder, and its name until it is complete.
FILE, PART = "recording.mcap", "recording.mcap.part"
#: The same recording with full frames, while there is room for it.
WHOLE = "recording.whole.mcap"
#: A recording whose frames are being reduced to a band.
BAND = "recording.mcap.band"
#: File with the place of the recording in a store.
STORED = "recording.stored.json"
#: File with the time and reason of a recording's removal.
REMOVED = "recording.removed.json"
#: A damaged recording, once its intact part has become `FILE`.
TORN = "recording.mcap.torn"
#: Messages recovered from memory, until they are in the recovered file.
REST = "recording.mcap.rest"

#: Files of a cycle that hold frames.
WITH_FRAMES: Final = (FILE, PART, WHOLE, BAND, TORN, REST)

IMAGE, FRAME, SEEN = "/camera/image", "/camera/frame", "/camera/seen"
MEASURED, COMMANDED = "/arm/measured", "/arm/commanded"
PATH, REVISION, ANSWER, ARM = "/arm/path", "/arm/revision", "/arm/answer", "/arm/state"
GRIPPER = "/gripper"
CYCLE, STATE, SETTINGS, TASK = "/cell/cycle", "/cell/state", "/cell/settings", "/cell/task"
FILMING, DECISION, MODEL = "/cell/filming", "/cell/decision", "/cell/model"
PASSAGE, FAULT = "/cell/passage", "/cell/fault"
RESULT, STUDY = "/cell/result", "/cell/study"
GAP, LOG = "/recording/gap", "/log"

#: Topics whose messages are JSON objects.
JSON_TOPICS: Final = (
    FRAME, PATH, REVISION, ANSWER, ARM, GRIPPER, CYCLE, STATE, SETTINGS, TASK, FILMING, DECISION,
    MODEL, PASSAGE, FAULT, RESULT, STUDY, GAP,
)  # fmt: skip

_NUMBER, _NUMBERS = {"type": "number"}, {"type": "array", "items": {"type": "number"}}
_PLACES = {"type": "array", "items": _NUMBERS}
_POSES = {"t_s": _NUMBERS, "x_m": _NUMBERS, "y_m": _NUMBERS, "angle_rad": _NUMBERS}
_PROPERTIES: Final[dict[str, dict[str, Any]]] = {
    FRAME: {"index": {"type": "integer"}, "t_s": _NUMBER, "blank": {"type": "integer"}},
    PATH: {"start_s": {"type": ["number", "null"]}, **_POSES},
    REVISION: {"from_s": _NUMBER, **_POSES},
    ANSWER: {"start_s": _NUMBER, "end_s": _NUMBER, **_POSES},
    ARM: {"t_s": _NUMBER, "mode": {"type": "string"}},
    GRIPPER: {"told": {"type": "string"}, "opening_m": _NUMBER, "holding": {"type": "boolean"}},
    CYCLE: {"cycle": {"type": "integer"}, "destination_px": _PLACES},
    PASSAGE: {"t_s": _NUMBERS, "tip_m": _PLACES, "predicted_m": _PLACES},
    STATE: {"state": {"type": "string"}, "step": {"type": ["string", "null"]}},
    GAP: {"first": {"type": "integer"}, "frames": {"type": "integer"}, "cause": {"type": "string"}},
}


def json_schema(topic: str) -> dict[str, Any]:
    """JSON schema of a topic's messages."""
    title = topic.strip("/").replace("/", "_")
    return {"type": "object", "title": title, "properties": _PROPERTIES.get(topic, {})}


def quaternion(angle_rad: float) -> tuple[float, float, float, float]:
    """x, y, z, w of a clamp angle: a turn about the plane's normal, against the clock."""
    return 0.0, 0.0, math.sin(angle_rad / 2.0), math.cos(angle_rad / 2.0)
