"""Commands are latched: none is lost, an abort outranks a stop, a pause can be taken back."""

from __future__ import annotations

import threading

import pytest

from cell.run.commands import Commands, InterruptedByCommandError
from cell.run.machine import Event


def test_nothing_interrupts_until_something_is_given() -> None:
    commands = Commands()
    commands.check()
    assert commands.pause is None


def test_a_stop_stays_until_it_is_cleared() -> None:
    commands = Commands()
    commands.give(Event.STOP, "guard opened")
    for _ in range(2):
        with pytest.raises(InterruptedByCommandError, match="stop: guard opened"):
            commands.check()
    commands.clear()
    commands.check()


def test_an_abort_outranks_a_stop_and_nothing_outranks_an_abort() -> None:
    commands = Commands()
    for event, reason in ((Event.STOP, "1"), (Event.STOP, "2"), (Event.ABORT, "3")):
        commands.give(event, reason)
    commands.give(Event.STOP, "4")
    with pytest.raises(InterruptedByCommandError) as caught:
        commands.check()
    assert (caught.value.event, caught.value.reason) == (Event.ABORT, "3")


def test_a_pause_lasts_until_it_is_taken_back() -> None:
    commands = Commands()
    commands.give(Event.HOLD)
    commands.give(Event.SUSPEND)
    commands.give(Event.HOLD)
    assert commands.pause is Event.HOLD
    commands.give(Event.UNHOLD)
    assert commands.pause is Event.SUSPEND
    commands.give(Event.UNSUSPEND)
    assert commands.pause is None
    commands.wait_until_resumed(Event.HOLD)


@pytest.mark.parametrize("event", [Event.UNHOLD, Event.STOP])
def test_who_waits_is_woken_by_whatever_ends_the_pause(event: Event) -> None:
    commands = Commands()
    commands.give(Event.HOLD)
    ended: list[str] = []

    def wait() -> None:
        try:
            commands.wait_until_resumed(Event.HOLD)
            ended.append("resumed")
        except InterruptedByCommandError:
            ended.append("interrupted")

    waiting = threading.Thread(target=wait)
    waiting.start()
    commands.give(event, "x")
    waiting.join(timeout=10.0)
    assert ended == ["resumed" if event is Event.UNHOLD else "interrupted"]


def test_a_pause_that_ended_before_the_process_was_halted_ends_in_a_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The arm went on as soon as the process did, long after it had been told to."""
    commands = Commands()
    commands.give(Event.HOLD)
    wait = commands._changed.wait

    def halted() -> bool:
        woken = wait()
        commands._resumed_s -= 1.5
        return woken

    monkeypatch.setattr(commands._changed, "wait", halted)
    timer = threading.Timer(0.05, commands.give, (Event.UNHOLD,))
    timer.start()
    with pytest.raises(InterruptedByCommandError, match=r"stop: unhold was given 1\.5 s ago"):
        commands.wait_until_resumed(Event.HOLD)


def test_what_is_no_command_to_a_running_cycle_is_refused() -> None:
    with pytest.raises(ValueError, match="'start' is no command to a running cycle"):
        Commands().give(Event.START)
