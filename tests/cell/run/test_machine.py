"""The cell's states: PackML's transitions, nothing else, with the time spent in each."""

from __future__ import annotations

import threading

import pytest

from cell.run.machine import TRANSITIONS, CellState, EventRefusedError, Machine, MachineEvent

#: States that wait for a command; the others end by themselves.
WAITING = {
    CellState.IDLE,
    CellState.COMPLETE,
    CellState.HELD,
    CellState.SUSPENDED,
    CellState.STOPPED,
    CellState.ABORTED,
}


class Stopwatch:
    t_s = 0.0

    def __call__(self) -> float:
        return self.t_s


#: One way to every state, from Stopped.
ROUTES = {
    CellState.STOPPED: "",
    CellState.RESETTING: "reset",
    CellState.IDLE: "reset done",
    CellState.STARTING: "reset done start",
    CellState.EXECUTE: "reset done start done",
    CellState.COMPLETING: "reset done start done done",
    CellState.COMPLETE: "reset done start done done done",
    CellState.HOLDING: "reset done start done hold",
    CellState.HELD: "reset done start done hold done",
    CellState.UNHOLDING: "reset done start done hold done unhold",
    CellState.SUSPENDING: "reset done start done suspend",
    CellState.SUSPENDED: "reset done start done suspend done",
    CellState.UNSUSPENDING: "reset done start done suspend done unsuspend",
    CellState.STOPPING: "reset stop",
    CellState.ABORTING: "abort",
    CellState.ABORTED: "abort done",
    CellState.CLEARING: "abort done clear",
}


def machine_in(state: CellState) -> Machine:
    machine = Machine(Stopwatch())
    for event in ROUTES[state].split():
        machine.send(MachineEvent(event))
    assert machine.state is state
    return machine


@pytest.mark.parametrize("state", CellState)
def test_every_event_does_what_the_table_says_or_is_refused(state: CellState) -> None:
    table = {(source, event): target for source, event, target in TRANSITIONS}
    for event in MachineEvent:
        machine = machine_in(state)
        target = table.get((state.value, event.value))
        assert machine.can(event) is (target is not None)
        if target is None:
            with pytest.raises(EventRefusedError, match=f"refused while {state.value}; possible"):
                machine.send(event)
            assert machine.state is state
        else:
            assert machine.send(event).value == target


def test_abort_comes_from_everywhere_and_stop_from_wherever_something_could_move() -> None:
    for state in CellState:
        machine = machine_in(state)
        ends_aborted = state in (CellState.ABORTING, CellState.ABORTED)
        assert machine.can(MachineEvent.ABORT) is not ends_aborted
        ends_still = state in (CellState.STOPPING, CellState.STOPPED)
        assert machine.can(MachineEvent.STOP) is not (ends_aborted or ends_still)


def test_every_state_either_waits_for_a_command_or_ends_by_itself() -> None:
    for state in CellState:
        assert machine_in(state).can(MachineEvent.DONE) is (state not in WAITING)


def test_only_clearing_and_resetting_lead_out_of_a_fault() -> None:
    machine = machine_in(CellState.ABORTED)
    with pytest.raises(EventRefusedError):
        machine.send(MachineEvent.RESET)
    for event in (MachineEvent.CLEAR, MachineEvent.DONE, MachineEvent.RESET, MachineEvent.DONE):
        machine.send(event)
    assert machine.state is CellState.IDLE


def test_time_is_counted_per_state() -> None:
    watch = Stopwatch()
    machine = Machine(watch)
    for t_s, event in ((1.0, "reset"), (1.5, "done"), (4.5, "start"), (4.75, "stop")):
        watch.t_s = t_s
        machine.send(MachineEvent(event))
    watch.t_s = 6.75
    seconds = machine.seconds()
    assert seconds[CellState.STOPPED] == 1.0
    assert seconds[CellState.RESETTING] == 0.5
    assert seconds[CellState.IDLE] == 3.0
    assert seconds[CellState.STARTING] == 0.25
    assert seconds[CellState.STOPPING] == 2.0, "the present state counts up to now"
    assert sum(seconds.values()) == watch.t_s


def test_listeners_are_told_every_new_state() -> None:
    told: list[CellState] = []
    machine = Machine(Stopwatch(), told.append)
    machine.send(MachineEvent.RESET)
    machine.send(MachineEvent.DONE)
    with pytest.raises(EventRefusedError):
        machine.send(MachineEvent.DONE)
    assert told == [CellState.RESETTING, CellState.IDLE]


def test_of_two_threads_that_abort_at_once_one_is_refused() -> None:
    machine = machine_in(CellState.EXECUTE)
    gate = threading.Barrier(8)
    refused: list[int] = []

    def abort(index: int) -> None:
        gate.wait()
        try:
            machine.send(MachineEvent.ABORT)
        except EventRefusedError:
            refused.append(index)

    threads = [threading.Thread(target=abort, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert machine.state is CellState.ABORTING
    assert len(refused) == 7
