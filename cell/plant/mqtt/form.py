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
    """What the adapter knows of the cell at the time of a message.

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
        """What the broker says when the adapter is lost; a new connection begins with it."""

    def can_publish(self) -> bool:
        """Whether somebody is there to be told."""

    def birth(self, known: PublishedState) -> list[Message]:
        """What is said first in a connection, and when the cell is reached or lost."""

    def of_notice(self, notice: Notice) -> list[Message]:
        """What is said of something that has happened, in its turn."""

    def of_status(self, known: PublishedState) -> list[Message]:
        """What is said when nothing waits any more."""

    def farewell(self, known: PublishedState) -> list[Message]:
        """What is said before the adapter ends."""

    def receive(self, topic: str, payload: bytes) -> bool:
        """Take in a message of a topic that was asked for; whether a birth is to follow.

        raises  EndOfSessionError: the connection is to be ended
        """


class EndOfSessionError(Exception):
    """The connection to the broker has to be closed and opened again.

    Scenario: the primary host of Sparkplug says that it goes offline.
    """
