"""Commands to a running cycle from any thread, and their reception by the cycle."""

from __future__ import annotations

import threading
import time

from cell.run.machine import MachineEvent
from drivers.interfaces import DeviceError

INTERRUPTING = frozenset({MachineEvent.STOP, MachineEvent.ABORT})
PAUSING = frozenset({MachineEvent.HOLD, MachineEvent.SUSPEND})
#: An older command to move is refused, s: its sender expects no motion any more.
OLDEST_S = 1.0
RESUMING = {MachineEvent.HOLD: MachineEvent.UNHOLD, MachineEvent.SUSPEND: MachineEvent.UNSUSPEND}


def too_old(command: str, requested_s: float) -> str:
    """Reason to refuse a command sent at `requested_s` on the monotonic clock; "" = none.

    Pages ask before they send a command, the service before it accepts and before it executes it.
    A time of a different clock is refused, too.
    """
    age_s = time.monotonic() - requested_s
    if abs(age_s) <= OLDEST_S:
        return ""
    return (
        f"{command} was given {age_s:.1f} s ago, and is refused after {OLDEST_S:g} s: a program "
        "between was halted; look at the cell, then give it again"
    )


class InterruptedByCommandError(Exception):
    """A stop or an abort came.  Scenario: somebody opens the guard in the middle of a step."""

    def __init__(self, event: MachineEvent, reason: str) -> None:
        super().__init__(f"{event.value}: {reason}")
        self.event = event
        self.reason = reason


class Commands:
    """Latched commands: sent from any thread, obeyed by the cycle at its next check.

    A stop or an abort interrupts a step; hold and suspend wait until the step has ended, because
    the swing of a cable cannot be interrupted and continued.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._interruption: tuple[MachineEvent, str] | None = None
        self._failure: DeviceError | None = None
        self._pauses: list[MachineEvent] = []
        self._resumed_s = 0.0

    def fail(self, error: DeviceError) -> None:
        """Latch that a device has failed; a command or a failure that came before counts."""
        with self._changed:
            if self._failure is None and self._interruption is None:
                self._failure = error
            self._changed.notify_all()

    def give(self, event: MachineEvent, reason: str = "") -> None:
        """Latch a command.  Raises ValueError: not a command that a running cycle obeys."""
        with self._changed:
            if event in INTERRUPTING:
                # An abort outranks a stop; otherwise the first reason is the one that counts.
                if self._interruption is None or (
                    event is MachineEvent.ABORT and self._interruption[0] is MachineEvent.STOP
                ):
                    self._interruption = (event, reason)
            elif event in PAUSING:
                if event not in self._pauses:
                    self._pauses.append(event)
            elif event in RESUMING.values():
                self._pauses = [p for p in self._pauses if RESUMING[p] is not event]
                self._resumed_s = time.monotonic()
            else:
                raise ValueError(f"{event.value!r} is no command to a running cycle")
            self._changed.notify_all()

    def check(self) -> None:
        """Raises InterruptedByCommandError after a stop or abort; DeviceError after a failure."""
        with self._changed:
            if self._failure is not None:
                raise self._failure
            if self._interruption is not None:
                raise InterruptedByCommandError(*self._interruption)

    @property
    def aborted(self) -> bool:
        """Whether there is an abort that was not acknowledged."""
        with self._changed:
            return self._interruption is not None and self._interruption[0] is MachineEvent.ABORT

    @property
    def pause(self) -> MachineEvent | None:
        """The requested pause that was not cancelled, if any."""
        with self._changed:
            return self._pauses[0] if self._pauses else None

    def resumes(self, event: MachineEvent) -> bool:
        """Whether `event` cancels a requested pause."""
        with self._changed:
            return any(RESUMING[pause] is event for pause in self._pauses)

    def wait_until_resumed(self, pause: MachineEvent) -> None:
        """Block while `pause` lasts.  Raises InterruptedByCommandError; DeviceError.

        A stop replaces the command that ended the pause if this process was halted since.
        """
        with self._changed:
            waited = False
            while pause in self._pauses and self._interruption is None and self._failure is None:
                waited = self._changed.wait()
            late = too_old(RESUMING[pause].value, self._resumed_s) if waited else ""
            if late and self._interruption is None:
                self._interruption = (MachineEvent.STOP, late)
        self.check()

    def clear(self) -> None:
        """Forget everything, after a person's acknowledgement."""
        with self._changed:
            self._interruption = self._failure = None
            self._pauses = []
