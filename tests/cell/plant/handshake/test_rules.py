"""The rules of the handshake: what may never happen, over any sequence of bits and states."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from cell.plant.handshake.carrier import Inputs, Outputs
from cell.plant.handshake.rules import (
    Ask,
    Memory,
    PlcInputs,
    evaluate,
    inputs_lost,
    not_obeyed,
    obeyed,
)
from cell.plant.messages import FaultNotice, Status, possible_in
from cell.run.machine import CellState, MachineEvent

FAULT = FaultNotice(1, "grip", "no cable", 0.0)


def status(state: CellState, **more: object) -> Status:
    made = Status("r", 1, state, 0.0, possible=possible_in(state))
    return replace(made, **more)  # type: ignore[arg-type]


any_inputs = st.builds(Inputs, *[st.booleans()] * 7)
any_status = st.none() | st.builds(
    lambda state, fault, run, cycles, outcome: status(
        state,
        fault=FAULT if fault else None,
        run=run,
        counts={outcome: cycles},
        last={"outcome": outcome},
    ),
    st.sampled_from([*CellState, *[CellState.IDLE] * 20]),
    st.integers(0, 9).map(lambda n: n == 0),
    st.sampled_from("aaab"),
    st.integers(0, 3),
    st.sampled_from(["inserted", "missed", "rejected", "failed"]),
)
looks = st.lists(st.tuples(any_inputs, any_status), min_size=2, max_size=30)


@settings(max_examples=150, deadline=None)
@given(looks)
def test_a_start_needs_an_edge_a_part_and_ready_and_no_fault(
    seen: list[tuple[Inputs, Status | None]],
) -> None:
    memory, outputs, start_was = Memory(), Outputs(), True
    for inputs, now in seen:
        ready_was = outputs.ready
        asks, outputs, memory = evaluate(inputs, now, memory)
        assert len(asks) <= 1
        assert not (outputs.ready and (outputs.busy or outputs.fault))
        assert outputs.done + outputs.rejected + outputs.busy <= 1
        if MachineEvent.START in [ask.command for ask in asks]:
            assert ready_was and inputs.start and not start_was
            assert inputs.part_present and inputs.upstream_ready and inputs.downstream_ready
            assert not inputs.stop
            assert now is not None and now.state is CellState.IDLE and now.fault is None
        if now is None:
            assert not asks and outputs.fault and not outputs.ready and not outputs.busy
        else:
            assert all(ask.command in now.possible for ask in asks) or asks[0].command is (
                MachineEvent.UNSUSPEND  # also takes back a pause that has not begun
            )
            assert outputs.fault or now.fault is None
        start_was = inputs.start


@settings(max_examples=50, deadline=None)
@given(st.lists(st.booleans(), max_size=40))
def test_an_idle_cell_gets_at_most_one_start_for_an_edge(levels: list[bool]) -> None:
    memory, starts = Memory(), 0
    for level in levels:
        asks, _, memory = evaluate(Inputs(start=level), status(CellState.IDLE), memory)
        starts += len(asks)
    edges = sum(not a and b for a, b in zip([True, *levels], levels, strict=False))
    assert starts == edges


def commands(
    inputs: Inputs, now: Status | None, memory: Memory
) -> tuple[list[MachineEvent], Outputs, Memory]:
    asks, outputs, memory = evaluate(inputs, now, memory)
    return [ask.command for ask in asks], outputs, memory


IDLE, EXECUTE = status(CellState.IDLE), status(CellState.EXECUTE)


def ready_memory() -> Memory:
    asks, outputs, memory = evaluate(Inputs(), IDLE, Memory())
    assert not asks and outputs == Outputs(ready=True)
    return memory


def test_a_start_that_is_held_at_connection_or_after_a_fault_does_nothing() -> None:
    held = Inputs(start=True)
    asked, outputs, memory = commands(held, IDLE, Memory())
    assert not asked and not outputs.ready
    for now in (status(CellState.ABORTED, fault=FAULT), None, IDLE, IDLE):
        asked, outputs, memory = commands(held, now, memory)
        assert not asked and not outputs.ready
    _, outputs, memory = commands(Inputs(), IDLE, memory)
    assert outputs.ready
    assert commands(held, IDLE, memory)[0] == [MachineEvent.START]
    assert commands(held, IDLE, inputs_lost(memory))[0] == []


def test_the_outcome_is_told_until_start_changes() -> None:
    for outcome, wanted in (
        ("inserted", Outputs(done=True)),
        ("missed", Outputs(rejected=True)),
        ("rejected", Outputs(rejected=True)),
        ("failed", Outputs()),
    ):
        held = Inputs(start=True)
        asked, _, memory = commands(held, IDLE, ready_memory())
        assert asked == [MachineEvent.START]
        _, outputs, memory = commands(held, EXECUTE, memory)
        assert outputs == Outputs(busy=True)
        ended = {"counts": {outcome: 1}, "last": {"outcome": outcome}}
        resetting, idle = status(CellState.RESETTING, **ended), status(CellState.IDLE, **ended)
        complete = status(CellState.COMPLETE, **ended)
        _, outputs, memory = commands(held, complete, memory)
        assert outputs == Outputs(busy=True)  # the result is known, and the cycle not over
        for now in (resetting, idle, idle):
            _, outputs, memory = commands(held, now, memory)
            assert outputs == wanted
        _, outputs, memory = commands(Inputs(), idle, memory)
        assert outputs == Outputs(ready=True)


def test_the_outcome_of_a_pulsed_start_waits_for_the_next() -> None:
    _, _, memory = commands(Inputs(start=True), IDLE, ready_memory())
    _, _, memory = commands(Inputs(), EXECUTE, memory)
    idle = status(CellState.IDLE, counts={"inserted": 1}, last={"outcome": "inserted"})
    for _ in range(3):
        _, outputs, memory = commands(Inputs(), idle, memory)
        assert outputs == Outputs(ready=True, done=True)
    asked, outputs, _ = commands(Inputs(start=True), idle, memory)
    assert asked == [MachineEvent.START] and outputs == Outputs()


def test_results_of_another_run_or_of_before_are_not_told() -> None:
    idle = status(CellState.IDLE, counts={"inserted": 5}, last={"outcome": "inserted"})
    _, outputs, memory = commands(Inputs(), idle, Memory())
    assert not outputs.done
    other = replace(idle, run="other", counts={"inserted": 9})
    assert not commands(Inputs(), other, memory)[1].done


def test_machines_beside_the_cell_suspend_it_once_and_let_it_go_on() -> None:
    memory = ready_memory()
    blocked = Inputs(downstream_ready=False)
    asks, _, memory = evaluate(blocked, EXECUTE, memory)
    assert asks == (Ask(MachineEvent.SUSPEND, "downstream"),)
    assert commands(blocked, EXECUTE, memory)[0] == []
    assert commands(Inputs(), EXECUTE, memory)[0] == [
        MachineEvent.UNSUSPEND
    ]  # not begun: taken back
    suspended = status(CellState.SUSPENDED, waiting_for=("downstream",))
    assert commands(blocked, suspended, memory)[0] == []
    asked, _, memory = commands(Inputs(), suspended, memory)
    assert asked == [MachineEvent.UNSUSPEND]
    assert commands(Inputs(), suspended, memory)[0] == []
    asked, _, memory = commands(Inputs(upstream_ready=False), EXECUTE, memory)
    assert asked == [MachineEvent.SUSPEND]


def test_after_a_restart_only_a_pause_of_the_line_is_ended() -> None:
    line = status(CellState.SUSPENDED, waiting_for=("upstream",))
    assert commands(Inputs(), line, Memory())[0] == [MachineEvent.UNSUSPEND]
    someone = status(CellState.SUSPENDED, waiting_for=("cleaning",))
    assert commands(Inputs(), someone, Memory())[0] == []


def test_one_acknowledgement_clears_and_resets() -> None:
    memory = ready_memory()
    pressed = Inputs(acknowledge=True)
    aborted, stopped = status(CellState.ABORTED, fault=FAULT), status(CellState.STOPPED)
    asked, outputs, memory = commands(pressed, aborted, memory)
    assert asked == [MachineEvent.CLEAR] and outputs == Outputs(fault=True)
    asked, _, memory = commands(pressed, status(CellState.CLEARING), memory)
    assert asked == []
    for again in (pressed, Inputs()):  # held, or a short pulse
        asked, outputs, after = commands(again, stopped, memory)
        assert asked == [MachineEvent.RESET] and outputs == Outputs(fault=True)
        assert commands(again, stopped, after)[0] == []
    assert commands(pressed, IDLE, after)[0] == []


def test_a_reset_follows_only_its_own_clear_and_nothing_else() -> None:
    pressed = Inputs(acknowledge=True)
    aborted, stopped = status(CellState.ABORTED, fault=FAULT), status(CellState.STOPPED)
    before = ready_memory()
    asks, _, cleared = evaluate(pressed, aborted, before)
    between: list[tuple[Inputs, Status | None]] = [
        (pressed, aborted),  # failed again
        (pressed, IDLE),  # somebody else reset it
        (pressed, None),
        (Inputs(acknowledge=True, stop=True), stopped),
        (pressed, replace(stopped, run="another")),
    ]
    for inputs, now in between:
        asked, _, memory = commands(inputs, now, cleared)
        assert MachineEvent.RESET not in asked
        assert commands(pressed, replace(stopped, run=memory.run or "r"), memory)[0] == []
    for lost in (inputs_lost(cleared), not_obeyed(asks[0], before, cleared)):
        assert commands(replace(pressed, acknowledge=False), stopped, lost)[0] == []
    assert commands(pressed, stopped, before)[0] == [MachineEvent.RESET]  # after a stop


def test_while_a_stop_is_held_no_acknowledgement_moves_the_hand() -> None:
    """A wire of the stop is broken: the gripper went home when somebody pressed the button."""
    stopped, held = status(CellState.STOPPED), Inputs(stop=True)
    _, _, memory = commands(held, stopped, Memory())
    _, _, memory = commands(held, stopped, memory)
    both = replace(held, acknowledge=True)
    asked, _, memory = commands(both, stopped, memory)
    assert asked == []
    asked, _, memory = commands(Inputs(acknowledge=True), stopped, memory)
    assert asked == [], "this press is over"
    _, _, memory = commands(Inputs(), stopped, memory)
    assert commands(Inputs(acknowledge=True), stopped, memory)[0] == [MachineEvent.RESET]


@settings(max_examples=60, deadline=None)
@given(looks)
def test_every_acknowledgement_is_used_once(seen: list[tuple[Inputs, Status | None]]) -> None:
    memory, was, used = Memory(), True, {MachineEvent.CLEAR, MachineEvent.RESET}
    for inputs, now in seen:
        if inputs.acknowledge and not was:
            used = set()
        asks, _, memory = evaluate(inputs, now, memory)
        for ask in asks:
            assert ask.command not in used
            used |= {ask.command} & {MachineEvent.CLEAR, MachineEvent.RESET}
        was = inputs.acknowledge


def test_a_stop_stops_once_and_waits_for_a_cell_that_is_away() -> None:
    stop = Inputs(stop=True)
    asked, _, memory = commands(stop, EXECUTE, ready_memory())
    assert asked == [MachineEvent.STOP]
    assert commands(stop, EXECUTE, memory)[0] == []
    lost = not_obeyed(Ask(MachineEvent.STOP), ready_memory(), memory)
    assert commands(stop, EXECUTE, lost)[0] == [MachineEvent.STOP]
    asked, outputs, memory = commands(stop, None, ready_memory())
    assert not asked and outputs == Outputs(fault=True)
    assert commands(stop, EXECUTE, memory)[0] == [MachineEvent.STOP]
    assert commands(stop, EXECUTE, Memory())[0] == [
        MachineEvent.STOP
    ]  # held when the PLC comes back


def test_an_outcome_is_told_after_the_plc_was_away_until_start_changes() -> None:
    made = status(CellState.IDLE, counts={"inserted": 1}, last={"outcome": "inserted"})
    for start in (False, True):
        _, outputs, memory = evaluate(Inputs(start=start), made, Memory(run="r", start=start))
        assert outputs.done
        _, outputs, memory = evaluate(Inputs(start=start), made, inputs_lost(memory))
        assert outputs.done
        assert not evaluate(Inputs(start=not start), made, inputs_lost(memory))[1].done


def test_what_did_not_reach_the_cell_is_asked_again_unless_it_starts_it() -> None:
    before = ready_memory()
    blocked = Inputs(upstream_ready=False)
    asks, _, after = evaluate(blocked, EXECUTE, before)
    assert commands(blocked, EXECUTE, not_obeyed(asks[0], before, after))[0] == [
        MachineEvent.SUSPEND
    ]
    asks, _, after = evaluate(Inputs(start=True), IDLE, before)
    after = not_obeyed(asks[0], before, after)
    assert commands(Inputs(start=True), IDLE, after)[0] == []


def test_a_start_that_is_obeyed_is_told_before_the_next_look() -> None:
    asks, outputs, _ = evaluate(Inputs(start=True), IDLE, ready_memory())
    assert obeyed(asks[0], outputs) == Outputs(busy=True)
    assert obeyed(Ask(MachineEvent.STOP), Outputs(busy=True)) == Outputs(busy=True)


def test_a_look_knows_who_is_in_the_way() -> None:
    for inputs, who in ((Inputs(), ""), (Inputs(upstream_ready=False), "upstream")):
        assert PlcInputs(inputs, IDLE, Memory()).obstacle == who


def test_a_start_is_of_the_product_whose_number_the_plc_says() -> None:
    idle = status(CellState.IDLE, products=("soft", "stiff"))
    for number, product in ((0, None), (1, "soft"), (2, "stiff")):
        said = {"product_0": bool(number & 1), "product_1": bool(number & 2)}
        _, outputs, memory = evaluate(Inputs(**said), idle, Memory())
        assert outputs.ready
        asks, *_ = evaluate(Inputs(start=True, **said), idle, memory)
        assert asks == (Ask(MachineEvent.START, product=product),)
    unknown = Inputs(product_0=True, product_1=True)
    _, outputs, memory = evaluate(unknown, idle, Memory())
    assert not outputs.ready, "there is no third"
    assert evaluate(replace(unknown, start=True), idle, replace(memory, ready=True))[0] == ()
