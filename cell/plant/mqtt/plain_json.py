"""Topics of plain JSON: `{prefix}/{line}/{what}`, one object each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from cell.files.plain import plain
from cell.plant.messages import MessageKind, Notice, to_json
from cell.plant.mqtt.form import Message, PublishedState

#: Of the messages; a receiver refuses one that it does not know.
VERSION = 1
CONNECTION, STATUS = "connection", "status"
#: Beside status and connection the broker keeps what holds until the next message.
_KEPT = frozenset({MessageKind.STATE, MessageKind.PRODUCT, MessageKind.WAITING})


class PlainJson:
    """Form of messages that any program can read.

    levels  first levels of all topics: prefix and line
    """

    asked: Sequence[str] = ()

    def __init__(self, levels: str) -> None:
        self._levels = levels

    def will(self) -> Message:
        """The adapter and, as far as anybody can know, the cell are away."""
        return self._message(CONNECTION, {"adapter": False, "cell": False}, retain=True)

    def may_begin(self) -> bool:
        """The broker is enough."""
        return True

    def birth(self, known: PublishedState) -> list[Message]:
        """Who is there, and the status."""
        said = {
            "adapter": True,
            "cell": known.is_cell,
            "dropped": known.dropped,
            "time_s": known.time_s,
        }
        return [self._message(CONNECTION, said, retain=True), *self.of_status(known)]

    def of_notice(self, notice: Notice) -> list[Message]:
        """A message of the topic that is called as the kind of the notice."""
        said = {
            "id": f"{notice.run}/{notice.sequence}",
            "run": notice.run,
            "sequence": notice.sequence,
            "time_s": notice.time_s,
            "data": notice.data,
        }
        return [self._message(notice.kind.value, said, retain=notice.kind in _KEPT)]

    def of_status(self, known: PublishedState) -> list[Message]:
        """All that is known of the cell now."""
        if known.status is None:
            return []
        said = {"time_s": known.time_s, "data": to_json(known.status)}
        return [self._message(STATUS, said, retain=True)]

    def farewell(self, known: PublishedState) -> list[Message]:
        """As the will, with the time."""
        said = {
            "adapter": False,
            "cell": False,
            "dropped": known.dropped,
            "time_s": known.time_s,
        }
        return [self._message(CONNECTION, said, retain=True)]

    def hear(self, topic: str, payload: bytes) -> bool:
        """Nothing was asked for, so nothing is obeyed."""
        return False

    def _message(self, what: str, said: dict[str, Any], *, retain: bool) -> Message:
        text = json.dumps({"version": VERSION, **plain(said)}, ensure_ascii=False)
        return Message(f"{self._levels}/{what}", text.encode(), 1, retain)
