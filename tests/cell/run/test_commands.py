"""Commands are latched: none is lost, an abort outranks a stop, a pause can be taken back."""

from __future__ import annotations

import threading

import pytest

from cell.run.commands import Commands, InterruptedByCommandError
from cell.run.machine import MachineEvent


def test_nothing_interrupts_until_something_is_given() -> None:
    commands = Commands()
    commands.check()
    assert commands.pause is None


def test_a_stop_stays_until_it_is_cleared() -> None:
    commands = Commands()
    commands.give(MachineEvent.STOP, "guard opened")
    for _ in range(2):
        with pytest.raises(InterruptedByCommandError, match="stop: guard opened"):
            commands.check()
    commands.clear()
    commands.check()


def test_an_abort_outranks_a_stop_and_nothing_outranks_an_abort() -> None:
    commands = Commands()
    for event, reason in (
        (MachineEvent.STOP, "1"),
        (MachineEvent.STOP, "2"),
        (MachineEvent.ABORT, "3"),
    ):
        commands.give(event, reason)
    commands.give(MachineEvent.STOP, "4")
    with pytest.raises(InterruptedByCommandError) as caught:
        commands.check()
    assert (caught.value.event, caught.value.reason) == (MachineEvent.ABORT, "3")


def test_a_pause_lasts_until_it_is_taken_back() -> None:
    commands = Commands()
    commands.give(MachineEvent.HOLD)
    commands.give(MachineEvent.SUSPEND)
    commands.give(MachineEvent.HOLD)
    assert commands.pause is MachineEvent.HOLD
    commands.give(MachineEvent.UNHOLD)
    assert commands.pause is MachineEvent.SUSPEND
    commands.give(MachineEvent.UNSUSPEND)
    assert commands.pause is None
    commands.wait_until_resumed(MachineEvent.HOLD)


@pytest.mark.parametrize("event", [MachineEvent.UNHOLD, MachineEvent.STOP])
def test_who_waits_is_woken_by_whatever_ends_the_pause(event: MachineEvent) -> None:
    commands = Commands()
    commands.give(MachineEvent.HOLD)
    ended: list[str] = []

    def wait() -> None:
        try:
            commands.wait_until_resumed(MachineEvent.HOLD)
            ended.append("resumed")
        except InterruptedByCommandError:
            ended.append("interrupted")

    waiting = threading.Thread(target=wait)
    waiting.start()
    commands.give(event, "x")
    waiting.join(timeout=10.0)
    assert ended == ["resumed" if event is MachineEvent.UNHOLD else "interrupted"]


def test_a_pause_that_ended_before_the_process_was_halted_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The arm went on as soon as the process did, long after it had been told to."""
    commands = Commands()
    commands.give(MachineEvent.HOLD)
    wait = commands._changed.wait

    def halted() -> bool:
        woken = wait()
        commands._resumed_s -= 1.5
        return woken

    monkeypatch.setattr(commands._changed, "wait", halted)
    timer = threading.Timer(0.05, commands.give, (MachineEvent.UNHOLD,))
    timer.start()
    with pytest.raises(InterruptedByCommandError, match=r"stop: unhold was given 1\.5 s ago"):
        commands.wait_until_resumed(MachineEvent.HOLD)


def test_what_is_no_command_to_a_running_cycle_is_refused() -> None:
    with pytest.raises(ValueError, match="'start' is no command to a running cycle"):
        Commands().give(MachineEvent.START)
