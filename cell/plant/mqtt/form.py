"""Messages to a broker, and the interface of their forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from cell.plant.messages import Notice, Status


@dataclass(frozen=True)
class Message:
    """One message to a broker.

    qos     0 = sent once, 1 = until the broker has acknowledged it
    retain  whether the broker keeps it for programs that come later
    """

    topic: str
    payload: bytes
    qos: int = 1
    retain: bool = False


@dataclass(frozen=True)
class PublishedState:
    """State of the cell, as known to the adapter at the time of a message.

    status   newest; None = no cell was reached since the adapter began
    is_cell  whether the cell is reached now
    dropped  messages that were dropped because too many waited for the broker
    time_s   now, Unix time
    """

    status: Status | None
    is_cell: bool
    dropped: int
    time_s: float


class PayloadForm(Protocol):
    """A form of messages: plain JSON, or Sparkplug B.

    subscriptions  topics that it subscribes to
    """

    subscriptions: Sequence[str]

    def will(self) -> Message:
        """Message that the broker publishes when the adapter is lost, for a new connection."""

    def can_publish(self) -> bool:
        """Whether a receiver is online."""

    def birth(self, known: PublishedState) -> list[Message]:
        """First messages of a connection, and those after the cell is reached or lost."""

    def of_notice(self, notice: Notice) -> list[Message]:
        """Messages for a notice, in its turn."""

    def of_status(self, known: PublishedState) -> list[Message]:
        """Messages for the status, when no notice waits any more."""

    def farewell(self, known: PublishedState) -> list[Message]:
        """Last messages before the adapter ends."""

    def receive(self, topic: str, payload: bytes) -> bool:
        """Take in a message of a subscribed topic; whether a birth is to follow.

        raises  EndOfSessionError: the connection is to be ended
        """


class EndOfSessionError(Exception):
    """The connection to the broker has to be closed and opened again.

    Scenario: the primary host of Sparkplug says that it goes offline.
    """
