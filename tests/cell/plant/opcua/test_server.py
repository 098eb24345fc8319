"""A client of OPC UA commands the cell and sees all of it, and what is not allowed is refused."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import ua

from cell.plant.messages import CommandReply, MessageKind, Request
from cell.plant.opcua import packml
from cell.plant.opcua.commands import COMMANDS
from cell.plant.opcua.server import _ViewPublisher
from cell.plant.opcua.unit import tags_of
from cell.run.machine import CellState, MachineEvent
from tests.waiting import free_port, wait_until

from .conftest import NAME, Seen, Site, served, settings_with

EXECUTE = "BaseStateMachine.MachineState.ExecuteState"
MACHINE = "BaseStateMachine.MachineState"
BASE = "BaseStateMachine"


class Changes:
    """Handler of a subscription."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.times: list[Any] = []
        self.events: list[Any] = []

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        self.values.append(value)
        self.times.append(data.monitored_item.Value.SourceTimestamp)

    def event_notification(self, event: Any) -> None:
        self.events.append(event)


def test_the_client_of_the_manual_starts_a_cycle_and_reads_outcome_and_miss(
    stopped: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[4] / "docs" / "howto" / "opcua.md").read_text(encoding="utf-8")
    [program] = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    cell = stopped.cell
    cell.send(MachineEvent.RESET)
    cable = f"A-{cell.cycle + 1}"
    for said, here in (("4840", str(stopped.port)), ("Line3", NAME), ("A-0001", cable)):
        assert said in program
        program = program.replace(said, here)

    def finish() -> None:
        wait_until(lambda: cell.machine.state is CellState.EXECUTE)
        cell.send(MachineEvent.DONE)

    thread = threading.Thread(target=finish)
    thread.start()
    exec(compile(program, "opcua.md", "exec"), {})
    thread.join()
    assert capsys.readouterr().out.splitlines() == ["Outcome inserted", "Miss -0.0012"]


def test_three_cycles_are_started_held_and_stopped_and_every_transition_is_seen(
    stopped: Site,
) -> None:
    cell, changes = stopped.cell, Changes()

    async def watch(seen: Seen) -> None:
        await seen.until("Cell.State", "stopped")
        subscription = await seen.client.create_subscription(50, changes)
        await subscription.subscribe_data_change(seen.node("Cell.State"))
        await subscription.subscribe_events(
            seen.client.nodes.server, ua.ObjectIds.TransitionEventType
        )
        assert await seen.call(f"{MACHINE}.Reset") == "Good"
        for _ in range(3):
            assert await seen.call(f"{EXECUTE}.Start", None) == "Good"
            assert await seen.call(f"{EXECUTE}.Hold") == "Good"
            assert await seen.call(f"{EXECUTE}.Start", None) == "BadInvalidState"
            assert await seen.call(f"{EXECUTE}.Unhold") == "Good"
            assert await seen.call(f"{EXECUTE}.Suspend") == "Good"
            assert await seen.call(f"{EXECUTE}.Unsuspend") == "Good"
            cell.send(MachineEvent.DONE)
            assert await seen.call(f"{EXECUTE}.Reset") == "Good"
        assert await seen.call(f"{MACHINE}.Stop") == "Good"
        await seen.until("Cell.State", "stopped")
        deadline_s = time.monotonic() + 30.0
        while len(changes.values) <= len(cell.states) or len(changes.events) < len(cell.states):
            assert time.monotonic() < deadline_s, (changes.values, len(changes.events))
            await asyncio.sleep(0.01)
        assert await seen.read("Cell.Counts.Inserted") >= 3
        assert await seen.read("Cell.LastResult.Outcome") == "inserted"
        [count] = await seen.read("Admin.ProdConsumedCount")
        assert count.Count == await seen.read("Cell.Counts.Inserted")

    stopped.look(watch)
    assert changes.values == ["stopped", *cell.states]
    assert len(cell.states) == 2 + 3 * 14 + 2
    assert changes.times == sorted(changes.times)
    assert [e.Message.Text.split(" to ")[1] for e in changes.events] == cell.states
    assert {r.by for r in cell.asked} == {"opcua:anonymous"}


def test_the_three_machines_say_which_state_is_active(stopped: Site) -> None:
    async def watch(seen: Seen) -> None:
        async def active() -> list[Any]:
            found = [await seen.read(f"{p}.CurrentState") for p in (BASE, MACHINE, EXECUTE)]
            return [f.Text if isinstance(f, ua.LocalizedText) else f for f in found]

        await seen.until("Cell.State", "stopped")
        assert await active() == ["Cleared", "Stopped", "BadStateNotActive"]
        assert await seen.call(f"{MACHINE}.Reset") == "Good"
        await seen.until("Cell.State", "idle")
        assert await active() == ["Cleared", "Running", "Idle"]
        assert await seen.read(f"{EXECUTE}.CurrentState.Number") == 4
        id_ = await seen.read(f"{EXECUTE}.CurrentState.Id")
        assert (await seen.client.get_node(id_).read_browse_name()).Name == "Idle"
        last = await seen.read(f"{MACHINE}.LastTransition.Id")
        assert (await seen.client.get_node(last).read_browse_name()).Name == "StoppedToRunning"
        assert await seen.call(f"{BASE}.Abort") == "Good"
        await seen.until("Cell.State", "aborted")
        assert await active() == ["Aborted", "BadStateNotActive", "BadStateNotActive"]

    stopped.look(watch)


def test_every_tag_can_be_read_and_has_the_type_that_it_says(stopped: Site) -> None:
    async def watch(seen: Seen) -> None:
        await seen.until("Cell.State", "stopped")
        for tag in tags_of("", None):
            data = await seen.node(tag.path).read_data_value(raise_on_bad_status=False)
            expected = ("BadNoData", "BadStateNotActive")
            assert data.StatusCode.is_good() or data.StatusCode.name in expected, tag.path
            rank = int(await seen.node(tag.path).read_value_rank())
            assert rank == (tag.type.count("[]") or -1), tag.path
            if data.StatusCode.is_good() and rank == -1:
                type_ = await seen.node(tag.path).read_data_type_as_variant_type()
                assert data.Value.VariantType == type_, tag.path

    stopped.look(watch)


def test_no_field_of_a_structure_is_optional(stopped: Site) -> None:
    """A client that loaded the definitions read None in every field: asyncua's default."""

    async def watch(seen: Seen) -> None:
        space = await seen.client.get_namespace_index(packml.URI)
        for structure in packml.STRUCTURES:
            node = seen.client.get_node(ua.NodeId(structure.id, space))
            definition = await node.read_data_type_definition()
            assert [f.Name for f in definition.Fields] == [name for name, _ in structure.fields]
            assert not any(f.IsOptional for f in definition.Fields)

    stopped.look(watch)


def test_a_fault_is_shown_and_only_a_person_clears_it(stopped: Site) -> None:
    cell = stopped.cell

    async def watch(seen: Seen) -> None:
        cell.fail("the jaws are empty")
        await seen.until("Cell.State", "aborted")
        assert await seen.read("Cell.Fault.Active") is True
        assert await seen.read("Cell.Fault.Cause") == "the jaws are empty"
        assert await seen.read("Cell.Fault.Remedy") == "look at it"
        [alarm] = await seen.read("Admin.Alarm")
        assert (alarm.Message, alarm.Trigger) == ("the jaws are empty; look at it", True)
        assert await seen.call(f"{BASE}.Clear") == "BadInvalidState"
        assert "Cell.Clear" in await seen.read("Cell.Refusal")
        assert await seen.call("Cell.Clear", "Ada", "") == "BadInvalidArgument"
        assert cell.asked == []
        assert await seen.call("Cell.Clear", "Ada", "jaws cleaned") == "Good"
        await seen.until("Cell.Fault.Active", False)
        await seen.until("Cell.State", "stopped")
        assert await seen.read("Cell.Refusal") == ""
        assert await seen.read("Cell.Acknowledged") == "opcua:anonymous (Ada): jaws cleaned"
        assert await seen.read("Admin.Alarm") == []
        [newest, *_] = await seen.read("Admin.AlarmHistory")
        assert newest.Trigger is False
        assert newest.AckDateTime >= newest.DateTime

    stopped.look(watch)
    assert cell.asked == [Request(MachineEvent.CLEAR, "opcua:anonymous (Ada)", "jaws cleaned")]


#: Commands that each state refuses, as PackML has it.
FORBIDDEN = [
    (CellState.STOPPED, f"{EXECUTE}.Start", [None]),
    (CellState.STOPPED, f"{EXECUTE}.Hold", []),
    (CellState.STOPPED, f"{EXECUTE}.Unhold", []),
    (CellState.STOPPED, f"{EXECUTE}.Suspend", []),
    (CellState.STOPPED, f"{EXECUTE}.Unsuspend", []),
    (CellState.STOPPED, f"{MACHINE}.Stop", []),
    (CellState.STOPPED, f"{BASE}.Clear", []),
    (CellState.STOPPED, "Cell.Start", ["A-1", "long"]),
]


def test_what_a_state_does_not_know_is_refused_with_a_status_and_a_reason(stopped: Site) -> None:
    async def watch(seen: Seen) -> None:
        for _, method, arguments in FORBIDDEN:
            assert await seen.call(method, *arguments) == "BadInvalidState", method
            assert "while stopped; possible now: " in await seen.read("Cell.Refusal")

    stopped.look(watch)
    assert stopped.cell.machine.state is CellState.STOPPED


def test_a_call_that_waited_at_a_halted_server_is_refused(stopped: Site) -> None:
    """It moved the arm as soon as the server went on."""

    async def watch(seen: Seen) -> None:
        halted = threading.Event()

        def halt() -> None:
            halted.set()
            time.sleep(1.3)

        assert stopped.loop is not None
        stopped.loop.call_soon_threadsafe(halt)
        await asyncio.to_thread(halted.wait)
        assert await seen.call(f"{MACHINE}.Reset") == "BadTimeout"
        assert "is refused after 1 s" in await seen.read("Cell.Refusal")
        assert stopped.cell.asked == []
        await asyncio.sleep(0.3)
        assert await seen.call(f"{MACHINE}.Reset") == "Good"

    stopped.look(watch)


def test_a_part_that_is_refused_is_named_by_its_argument(
    stopped: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The status said that the state forbids it."""
    why = CommandReply(False, CellState.IDLE, "part 'S-1' is of product soft", "part")
    monkeypatch.setattr(stopped.cell.link, "_handler", lambda request: why)

    async def watch(seen: Seen) -> None:
        cell = seen.node("Cell")
        request = ua.CallMethodRequest(
            ObjectId=cell.nodeid,
            MethodId=seen.node("Cell.Start").nodeid,
            InputArguments=[ua.Variant("S-1"), ua.Variant("stiff")],
        )
        [result] = await seen.client.uaclient.call([request])
        assert result.StatusCode.name == "BadInvalidArgument"
        assert [c.name for c in result.InputArgumentResults] == ["BadOutOfRange", "Good"]
        assert await seen.read("Cell.Refusal") == "start: part 'S-1' is of product soft"

    stopped.look(watch)


def test_no_node_has_a_history(stopped: Site) -> None:
    """It was read as Good, and empty."""
    nobody = ua.NodeId("nobody", 1)

    async def watch(seen: Seen) -> None:
        nodes = [seen.node("Cell.State").nodeid, nobody]
        for details in (ua.ReadRawModifiedDetails(), ua.ReadEventDetails()):
            wanted = ua.HistoryReadParameters(
                HistoryReadDetails=details,
                NodesToRead=[ua.HistoryReadValueId(NodeId=node) for node in nodes],
            )
            found = await seen.client.uaclient.history_read(wanted)
            assert [r.StatusCode.name for r in found] == [
                "BadHistoryOperationUnsupported",
                "BadNodeIdUnknown",
            ]

    stopped.look(watch)


@pytest.mark.parametrize(
    ("method", "arguments", "status"),
    [
        ("SetUnitMode", [ua.Variant(1, ua.VariantType.Int32)], "BadNotImplemented"),
        ("SetUnitMode", ["1"], "BadInvalidArgument"),
        ("SetMachSpeed", [], "BadArgumentsMissing"),
        (f"{EXECUTE}.Hold", ["now"], "BadTooManyArguments"),
        ("Cell.SelectProduct", ["unheard of"], "BadInvalidArgument"),
        ("Cell.SelectProduct", ["x" * 5000], "BadInvalidArgument"),
        ("SetProduct", [None], "BadInvalidArgument"),
    ],
)
def test_wrong_arguments_are_named(
    stopped: Site, method: str, arguments: list[Any], status: str
) -> None:
    async def watch(seen: Seen) -> None:
        await seen.until("Cell.Connected", True)
        assert await seen.call(method, *arguments) == status

    stopped.look(watch)
    assert stopped.cell.asked == []


def test_products_are_chosen_by_name_and_by_number(stopped: Site) -> None:
    async def watch(seen: Seen) -> None:
        await seen.until("Cell.Products", ["short", "long"])
        assert await seen.call("Cell.SelectProduct", "short") == "Good"
        await seen.until("Cell.Product", "short")
        product = ua.PackMLProductDataType(2)
        assert await seen.call("SetProduct", ua.Variant([product], is_array=True)) == "Good"
        await seen.until("Cell.Product", "long")
        [shown] = await seen.read("Status.Product")
        assert shown.ProductID == 2

    stopped.look(watch)


def test_methods_are_found_by_their_types_too_and_only_at_their_object(stopped: Site) -> None:
    async def watch(seen: Seen) -> None:
        hold = ua.NodeId(next(c.type_id for c in COMMANDS if c.name == "Hold"), seen.standard)
        for of, status in ((EXECUTE, "BadInvalidState"), (MACHINE, "BadMethodInvalid")):
            with pytest.raises(ua.UaStatusCodeError) as refused:
                await seen.node(of).call_method(hold)
            assert ua.StatusCode(refused.value.code).name == status

    stopped.look(watch)


def test_nobody_writes(stopped: Site) -> None:
    async def watch(seen: Seen) -> None:
        for path in ("Cell.State", "Status.UnitModeCurrent", f"{BASE}.CurrentState"):
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                await seen.node(path).write_value("idle")

    stopped.look(watch)


def test_a_server_without_a_cell_says_so_and_shows_it_when_it_comes(tmp_path: Path) -> None:
    from cell.settings.plant import OpcUa

    from .conftest import NAME, FakeCell

    runs, port = tmp_path / "runs", free_port()
    opcua = OpcUa(port=port, folder=tmp_path / "opcua", name=NAME)
    cell = FakeCell(runs)
    alone = Site(cell, port, opcua.folder, runs)

    async def watch(seen: Seen) -> None:
        assert await seen.read("Cell.Connected") is False
        assert await seen.read("Cell.State") == "not connected"
        assert await seen.read("Cell.StateCurrent") == 0
        assert await seen.read(f"{BASE}.CurrentState") == "BadNoCommunication"
        assert await seen.read("Cell.Cycle") == "BadNoCommunication"
        assert await seen.call(f"{MACHINE}.Stop") == "BadNoCommunication"
        assert await seen.read("Cell.Refusal") == "stop: the cell does not run"
        with cell.link:
            await seen.until("Cell.State", "stopped")
            cell.link.publish(MessageKind.CYCLE, {"cycle": 7, "part": None, "product": None})
            await seen.until("Cell.Cycle", 7)
        await seen.until("Cell.State", "not connected")
        data = await seen.node("Cell.Cycle").read_data_value(raise_on_bad_status=False)
        assert (data.Value.Value, data.StatusCode.name) == (7, "UncertainLastUsableValue")
        assert await seen.read(f"{BASE}.CurrentState") == "BadNoCommunication"
        with FakeCell(runs).link:
            await seen.until("Cell.State", "stopped")
            await seen.until("Cell.Cycle", 0)

    with served(settings_with(opcua), runs):
        alone.look(watch)


def test_a_taken_port_is_named(stopped: Site, tmp_path: Path) -> None:
    from cell.settings.plant import OpcUa

    opcua = OpcUa(port=stopped.port, folder=tmp_path / "opcua")
    with (
        pytest.raises(ValueError, match=rf"cannot listen at 127.0.0.1, port {stopped.port}"),
        served(settings_with(opcua), tmp_path),
    ):
        pass


@pytest.mark.parametrize("turns", range(4))
def test_it_ends_though_a_message_comes_as_it_is_stopped(turns: int) -> None:
    """Now and then the server never ended: it forgot that it was cancelled."""

    async def none_shown(*_: object) -> None:
        return None

    async def stopped() -> bool:
        shown = _ViewPublisher(SimpleNamespace(show=none_shown), SimpleNamespace())  # type: ignore[arg-type]
        showing = asyncio.create_task(shown.show())
        for _ in range(4):
            await asyncio.sleep(0)  # it waits for a message
        shown.lost()
        await asyncio.sleep(0)  # the message is put
        for _ in range(turns):
            await asyncio.sleep(0)
        shown.closed = True
        showing.cancel()
        done, _ = await asyncio.wait({showing}, timeout=3.0)
        showing.cancel()
        return bool(done)

    assert asyncio.run(stopped())
