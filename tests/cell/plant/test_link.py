"""Link and client: what a cell publishes reaches programs beside it, whatever they do."""

from __future__ import annotations

import gc
import json
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest

from cell.plant import server
from cell.plant.client import Client
from cell.plant.link import Link
from cell.plant.messages import PROTOCOL, CommandReply, MessageKind, Notice, Request, Status
from cell.plant.server import CommandServer
from cell.plant.wire import LinkError, NoCellError, ProtocolError, line_of, socket_of
from cell.run.machine import CellState, MachineEvent
from tests.waiting import wait_until

BEGUN = Status(run="", sequence=0, state=CellState.STOPPED, since_s=0.0, line="line 1")


def obeys(request: Request) -> CommandReply:
    return CommandReply(True, CellState.EXECUTE, repr(request))


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def link(runs: Path) -> Iterator[Link]:
    with Link(runs, BEGUN, obeys) as opened:
        yield opened


@pytest.fixture
def client(runs: Path) -> Iterator[Client]:
    client = Client(runs)
    yield client
    client.close()


def goes_to(link: Link, state: CellState) -> Notice:
    return link.publish(MessageKind.STATE, {"state": state.value, "step": None, "since": 5.0})


def test_notices_that_follow_each_other_are_sent_together_and_in_order(
    link: Link, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Woken at every notice, the link's threads cost the robot's wait 13 %."""
    woken = list[float]()
    wake = CommandServer.wake

    def counted(server: CommandServer) -> None:
        woken.append(time.monotonic())
        wake(server)

    followed = client.follow((link.run, 0))
    monkeypatch.setattr(CommandServer, "wake", counted)
    count, begun_s = 50, time.monotonic()
    for number in range(count):
        link.publish(MessageKind.STEP, {"step": "simulate", "cycle": number})
        time.sleep(0.002)  # other threads get their turn
    seen = [n.data["cycle"] for n in islice(followed, count)]
    assert seen == list(range(count))
    assert len(woken) <= 1 + (time.monotonic() - begun_s) / 0.04


def test_a_status_contains_what_was_published(link: Link, client: Client) -> None:
    goes_to(link, CellState.IDLE)
    link.publish(MessageKind.WAITING, {"waiting_for": ["start"]})
    link.publish(MessageKind.CYCLE, {"cycle": 3, "part": "A-3", "product": "long"})
    link.publish(MessageKind.RESULT, {"cycle": 3, "outcome": "inserted", "margin_m": 0.001})
    link.publish(MessageKind.FAULT, {"cycle": 3, "step": "grasp", "cause": "none", "time_s": 1.0})
    status = client.connect().status()
    assert status.run == link.run
    assert (status.sequence, status.state, status.since_s) == (5, CellState.IDLE, 5.0)
    assert status.possible == (MachineEvent.START, MachineEvent.STOP, MachineEvent.ABORT)
    assert status.waiting_for == ("start",)
    assert (status.cycle, status.part, status.product) == (3, "A-3", "long")
    assert status.counts == {"inserted": 1}
    assert status.last == {"cycle": 3, "outcome": "inserted", "margin_m": 0.001}
    assert status.fault is not None
    assert status.fault.cause == "none"
    assert status.line == "line 1"
    assert set(status.state_seconds) == {"stopped", "idle"}
    link.publish(MessageKind.ACKNOWLEDGED, {"by": "Ada", "note": ""})
    assert client.status().fault is None


def test_whoever_follows_gets_a_status_and_then_every_notice(link: Link, client: Client) -> None:
    goes_to(link, CellState.IDLE)
    followed = client.follow()
    first = next(followed)
    assert isinstance(first, Status)
    assert first.sequence == 1
    sent = [goes_to(link, CellState.STARTING), goes_to(link, CellState.EXECUTE)]
    assert list(islice(followed, 2)) == sent


def test_whoever_comes_back_goes_on_where_it_was(link: Link, client: Client) -> None:
    sent = [goes_to(link, CellState.IDLE) for _ in range(5)]
    assert list(islice(client.follow((link.run, 2)), 3)) == sent[2:]


@pytest.mark.parametrize("after", [("another run", 2), (None, 99), (None, -1)])
def test_without_continuity_a_status_comes_first(
    link: Link, client: Client, after: tuple[str | None, int]
) -> None:
    for _ in range(5):
        goes_to(link, CellState.IDLE)
    first = next(client.follow((after[0] or link.run, after[1])))
    assert isinstance(first, Status)
    assert first.sequence == 5


def test_who_asks_for_more_than_is_kept_gets_a_status(
    runs: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "MOST_NOTICES", 10)
    with Link(runs, BEGUN, obeys) as link:
        for _ in range(30):
            goes_to(link, CellState.IDLE)
        assert isinstance(next(client.follow((link.run, 19))), Status)
        kept = client.follow((link.run, 20))
        assert [notice.sequence for notice in islice(kept, 10)] == list(range(21, 31))


def test_a_client_waits_for_the_next_run_and_is_told_of_the_loss(runs: Path) -> None:
    lost = threading.Event()
    client = Client(runs, on_lost=lost.set)
    followed = client.follow()
    with Link(runs, BEGUN, obeys) as before:
        assert next(followed).run == before.run
        last = goes_to(before, CellState.IDLE)
        assert next(followed) == last
    begun: list[Link] = []

    def begin_again() -> None:
        assert lost.wait(20.0)
        begun.append(Link(runs, BEGUN, obeys).__enter__())

    thread = threading.Thread(target=begin_again)
    thread.start()
    first = next(followed)
    thread.join()
    assert isinstance(first, Status)
    assert first.run == begun[0].run != before.run
    begun[0].__exit__(None, None, None)
    client.close()


def test_who_asks_again_is_answered_by_the_cell_that_runs_then(runs: Path) -> None:
    client = Client(runs)
    for _ in range(2):
        with Link(runs, BEGUN, obeys) as link:
            for _ in range(3):
                assert client.status().run == link.run
            assert client._open == set()
    with pytest.raises(NoCellError):
        client.status()


def test_a_request_is_answered(link: Link, client: Client) -> None:
    request = Request(MachineEvent.START, "plc", part="A-17", product="long", note="Grüße\n")
    assert client.send(request) == CommandReply(True, CellState.EXECUTE, repr(request))
    assert client.send(Request(None, "plc", product="long")).accepted


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (Request(MachineEvent.DONE, "plc"), "no command"),
        (Request(MachineEvent.START, ""), "who asks"),
        (Request(MachineEvent.START, "plc", part="x" * 2000), "part is no text"),
    ],
)
def test_what_is_no_request_is_refused(
    link: Link, client: Client, request_: Request, reason: str
) -> None:
    answer = client.send(request_)
    assert not answer.accepted
    assert reason in answer.reason


def test_half_a_character_is_refused_before_it_is_told_on(link: Link, runs: Path) -> None:
    """A part's id of this kind was taken, and then no program got the cell's status any more."""
    asks = b'{"request":{"command":"start","by":"plc","asked_s":1.0,"part":"A-\\ud83d"}}\n'
    said = say(runs, line_of("greeting", {"protocol": PROTOCOL}), asks, line_of("dance", 1))
    [answer] = [line["answer"] for line in said if isinstance(line, dict) and "answer" in line]
    assert not answer["accepted"]
    assert "part is no text" in answer["reason"]


@pytest.mark.parametrize("age_s", [1.5, -1.5])
def test_a_command_that_comes_too_late_is_refused_and_a_stop_is_not(
    link: Link, client: Client, age_s: float
) -> None:
    """A start that waited in the socket of a halted cell moved the arm when it went on."""
    asked_s = time.monotonic() - age_s
    for command in (MachineEvent.START, MachineEvent.RESET, MachineEvent.UNHOLD, None):
        answer = client.send(Request(command, "plc", product="soft", asked_s=asked_s))
        assert (answer.accepted, answer.wrong) == (False, "asked_s")
        assert "s ago, and is refused after 1 s" in answer.reason
    for command in (MachineEvent.STOP, MachineEvent.ABORT):
        assert client.send(Request(command, "plc", asked_s=asked_s)).accepted


def test_a_command_without_a_time_is_refused(link: Link, runs: Path) -> None:
    asks = b'{"request":{"command":"start","by":"plc"}}\n'
    said = say(runs, line_of("greeting", {"protocol": PROTOCOL}), asks, line_of("dance", 1))
    [answer] = [line["answer"] for line in said if isinstance(line, dict) and "answer" in line]
    assert not answer["accepted"] and "asked_s is missing" in answer["reason"]


def test_a_handler_that_fails_refuses(runs: Path, client: Client) -> None:
    def fails(request: Request) -> CommandReply:
        raise RuntimeError("broken")

    with Link(runs, BEGUN, fails):
        for _ in range(2):
            answer = client.send(Request(MachineEvent.START, "plc"))
            assert answer == CommandReply(False, CellState.STOPPED, "RuntimeError: broken")


def test_without_a_cell_a_client_says_so(runs: Path, client: Client) -> None:
    for ask in (client.connect, client.status):
        with pytest.raises(NoCellError, match="no cell runs with the records"):
            ask()
    with Link(runs, BEGUN, obeys):
        client.connect()
    assert not socket_of(runs).exists()
    assert list(runs.parent.iterdir()) == []
    with pytest.raises(NoCellError):
        client.status()


def test_a_client_can_be_closed_from_another_thread(link: Link, runs: Path) -> None:
    client = Client(runs)
    heard: list[object] = []
    thread = threading.Thread(target=lambda: heard.extend(client.follow()))
    thread.start()
    goes_to(link, CellState.IDLE)
    wait_until(lambda: bool(heard))
    client.close()
    thread.join(20.0)
    assert not thread.is_alive()
    with pytest.raises(LinkError, match="closed"):
        client.status()


def test_only_this_user_may_connect_and_only_one_cell_can_be_there(link: Link, runs: Path) -> None:
    assert socket_of(runs).stat().st_mode & 0o777 == 0o600
    with pytest.raises(LinkError, match="another cell runs there already"):
        Link(runs, BEGUN, obeys).__enter__()
    Client(runs).connect()


def test_the_socket_of_a_killed_cell_is_taken_over(runs: Path, client: Client) -> None:
    program = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from cell.plant.link import Link\n"
        "from cell.plant.messages import Status\n"
        "from cell.run.machine import CellState\n"
        "with Link(Path(sys.argv[1]), Status('', 0, CellState.IDLE, 0.0), None):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(runs)], check=False)
    assert socket_of(runs).exists()
    with pytest.raises(NoCellError):
        client.connect()
    with Link(runs, BEGUN, obeys) as link:
        assert client.status().run == link.run


def test_a_long_path_has_its_socket_elsewhere(tmp_path: Path) -> None:
    runs = tmp_path / ("long" * 30) / "runs"
    path = socket_of(runs)
    assert len(bytes(path)) < 100
    assert path.parent != runs.parent
    assert socket_of(runs.with_name("others")) != path
    with Link(runs, BEGUN, obeys) as link:
        assert Client(runs).status().run == link.run
    assert not path.exists()


def say(runs: Path, *lines: bytes) -> list[object]:
    """Raw lines to the cell; what it says until it ends the conversation."""
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(20.0)
        raw.connect(str(socket_of(runs)))
        for line in lines:
            raw.sendall(line)
        heard = b""
        while new := raw.recv(65536):
            heard += new
    return [json.loads(line) for line in heard.splitlines()]


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ([line_of("greeting", {"protocol": PROTOCOL + 1})], "update the older"),
        ([line_of("status", None)], "no greeting"),
        ([b"GET / HTTP/1.1\r\n\r\n"], ""),
        ([b"[1, 2]\n"], "one key"),
        ([b"\xff\xfe\n"], ""),
        ([b"[" * 100_000 + b"\n"], "nested"),
        ([line_of("greeting", {"protocol": PROTOCOL}), line_of("dance", 1)], "no message"),
    ],
)
def test_who_speaks_otherwise_is_sent_away(
    link: Link, runs: Path, lines: list[bytes], reason: str
) -> None:
    *_, last = say(runs, *lines)
    assert isinstance(last, dict)
    assert reason in last["refused"]
    Client(runs).connect()


def test_a_cell_of_another_version_is_not_talked_to(
    runs: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.plant.server.PROTOCOL", PROTOCOL + 1)
    with Link(runs, BEGUN, obeys), pytest.raises(ProtocolError, match="update the older"):
        client.connect()


def follower(runs: Path) -> socket.socket:
    """A program that follows and never reads."""
    raw = socket.socket(socket.AF_UNIX)
    raw.connect(str(socket_of(runs)))
    raw.sendall(line_of("greeting", {"protocol": PROTOCOL}) + line_of("follow", None))
    return raw


def test_programs_that_do_not_read_are_disconnected_and_the_others_lose_nothing(
    link: Link, runs: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "MOST_NOTICES", 1500)
    stalled = [follower(runs) for _ in range(50)]
    heard: list[Notice | Status] = []
    thread = threading.Thread(target=lambda: heard.extend(client.follow()))
    thread.start()
    wait_until(lambda: bool(heard))
    for number in range(3000):
        link.publish(MessageKind.STEP, {"step": "x" * 1000, "cycle": number})
        time.sleep(0.0002)
    wait_until(lambda: len(heard) == 3001)
    client.close()
    thread.join()
    assert [n.sequence for n in heard] == list(range(3001))
    for raw in stalled:  # what was sent before is still there, then the end
        raw.settimeout(20.0)
        while raw.recv(1 << 20):
            pass
        raw.close()
    assert Client(runs).status().sequence == 3000


def test_a_program_that_is_told_nothing_more_sees_the_cell_as_away(
    link: Link, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> bool:
        raise RuntimeError("broken")

    monkeypatch.setattr(CommandServer, "_send_news", broken)
    with follower(runs) as raw:
        raw.settimeout(20.0)
        while raw.recv(1 << 16):
            pass
    monkeypatch.undo()
    Client(runs).connect()


def test_a_notice_is_in_the_journal_before_it_is_looked_for() -> None:
    """Two threads meet there: one adds a notice while the other sends what there is."""
    journal = server.Journal()

    class Lines(dict[int, bytes]):
        def __setitem__(self, sequence: int, line: bytes) -> None:
            assert journal.newest < sequence  # the other thread gets its turn now
            super().__setitem__(sequence, line)

    journal._lines = Lines()
    for line in (b"1\n", b"2\n"):
        journal.add(line)
    assert [journal.after(told) for told in range(journal.newest)] == [b"1\n", b"2\n"]


def test_a_program_that_asks_without_reading_is_disconnected(link: Link, runs: Path) -> None:
    with follower(runs) as raw:
        raw.settimeout(20.0)
        with pytest.raises(ConnectionError):
            for _ in range(100_000):
                raw.sendall(line_of("status", None) * 10)
    Client(runs).connect()


def test_no_connection_is_left_open_at_the_end(runs: Path) -> None:
    """Of programs that follow and read nothing, that were refused, that connect at the end."""
    gc.collect()
    others = set(threading.enumerate())  # other tests' cells may still run in this process
    programs: list[socket.socket] = []

    def connected() -> socket.socket:
        programs.append(socket.socket(socket.AF_UNIX))
        programs[-1].connect(str(socket_of(runs)))
        return programs[-1]

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(5):
            with Link(runs, BEGUN, obeys) as link:
                follower, refused = connected(), connected()
                follower.sendall(line_of("greeting", {"protocol": PROTOCOL}))
                follower.sendall(line_of("follow", {"run": None, "sequence": None}))
                for number in range(3000):
                    link.publish(MessageKind.STEP, {"step": "x" * 200, "cycle": number})
                wait_until(lambda link=link: link.status().sequence == 3000)
                refused.sendall(b"no line\n")
                connected()
            gc.collect()
        for program in programs:
            program.close()
    said = [str(w.message) for w in told]
    assert [m for m in said if "unclosed" in m and str(socket_of(runs)) in m] == []
    wait_until(lambda: "link socket" not in {t.name for t in {*threading.enumerate()} - others})
