"""What happens when a thread dies: a stop or a named degradation, as docs say."""

from __future__ import annotations

import ast
import asyncio
import json
import logging
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from pickle import PicklingError
from types import SimpleNamespace
from typing import Any

import pytest

from cell.cli.keyboard import Keyboard
from cell.computer import abilities
from cell.computer.forks import stream
from cell.plant.children import Adapters
from cell.plant.client import Client
from cell.plant.handshake.carrier import CarrierError
from cell.plant.handshake.modbus import ModbusCarrier
from cell.plant.link import Link
from cell.plant.mqtt.adapter import OutboxFeeder
from cell.plant.opcua import server as opcua_server
from cell.plant.server import CommandServer
from cell.plant.service import Service
from cell.plant.wire import LinkError
from cell.records.ledger.outbox import LedgerWriter
from cell.records.recording import form
from cell.records.recording.process import RingConsumer
from cell.records.recording.recorder import _PoseStream
from cell.records.recording.uploads import Uploads
from cell.records.recording.writer import RecordingWriter
from cell.run.commands import Commands
from cell.run.machine import MachineEvent
from cell.run.waiting import result_of
from cell.settings.plant import Handshake, OpcUa
from cell.web import guided as guided_module
from cell.web.camera import LiveCamera
from cell.web.guided import Guided
from cell.web.jobs import Jobs, JobState
from cell.web.watching import CellWatch, WatchedState
from drivers import ur_dashboard
from drivers.capture import StreamingCamera
from drivers.interfaces import ConnectError
from drivers.recording import CaptureOptions
from drivers.threads import GuardedThread, only_logged
from drivers.ur_child import _Child, _LostError
from drivers.ur_dashboard import RemoteControl
from drivers.ur_io import UrIo
from tests.cell.plant.opcua.conftest import settings_with
from tests.cell.plant.test_link import BEGUN, obeys
from tests.cell.plant.test_service import service_of
from tests.cell.web.test_jobs import newest, started, task
from tests.waiting import free_port, wait_until

ROOT = Path(__file__).parents[2]
_ROW = re.compile(r"\| `([\w/]+\.py)` \| ([^|]+) \| [^|]+ \|")
#: What begins a thread or a task, or is a thread.
BEGINS = {
    "Thread",
    "GuardedThread",
    "Timer",
    "ThreadPoolExecutor",
    "ProcessPoolExecutor",
    "create_task",
    "ensure_future",
    "to_thread",
    "run_in_executor",
}


def boom(*_: Any, **__: Any) -> Any:
    raise ValueError("boom")


def dies(thread: GuardedThread) -> None:
    """Let its work raise, here and now."""
    thread._work = boom
    thread.run()


# --- the table ------------------------------------------------------------------------------------


def begun_in_the_program() -> Iterator[tuple[str, str]]:
    """Module and kind of every thread and task."""
    for file in sorted(ROOT.glob("*/**/*.py")):
        module = str(file.relative_to(ROOT))
        if not module.startswith(("cell/", "drivers/", "calib/")):
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names: list[ast.expr] = []
            if isinstance(node, ast.Call):
                names = [node.func]
            elif isinstance(node, ast.ClassDef) and module != "drivers/threads.py":
                names = node.bases
            for name in names:
                called = getattr(name, "attr", getattr(name, "id", ""))
                if called in BEGINS:
                    yield module, called


#: Module, what begins there, and the test of what follows when it dies.
TESTED = """
cell/run/watch.py GuardedThread a_watch_that_dies_stops_the_arm
drivers/capture.py GuardedThread a_camera_whose_thread_dies_is_lost
drivers/ur_dashboard.py GuardedThread an_arm_of_which_nobody_knows_who_has_control_is_lost
drivers/ur_io.py GuardedThread inputs_of_an_arm_that_are_heard_no_more_are_lost
cell/plant/service.py GuardedThread a_service_without_signs_of_life_ends
cell/plant/link.py GuardedThread a_link_that_dies_is_a_cell_that_is_away
cell/plant/link.py GuardedThread a_link_that_dies_is_a_cell_that_is_away
cell/plant/server.py GuardedThread a_link_that_dies_is_a_cell_that_is_away
cell/plant/server.py create_task a_program_that_is_told_nothing_more_sees_the_cell_as_away
cell/plant/children.py GuardedThread an_adapter_that_is_kept_no_more_is_told
cell/plant/mqtt/adapter.py GuardedThread an_mqtt_adapter_that_takes_nothing_ends
cell/plant/mqtt/adapter.py create_task an_adapter_that_is_killed_goes_on_where_it_was
cell/plant/mqtt/adapter.py to_thread an_adapter_that_is_killed_goes_on_where_it_was
cell/plant/opcua/server.py GuardedThread an_opcua_server_that_shows_nothing_new_ends
cell/plant/opcua/server.py create_task an_opcua_server_that_shows_nothing_new_ends
cell/plant/opcua/server.py to_thread an_opcua_server_that_shows_nothing_new_ends
cell/plant/opcua/commands.py to_thread an_opcua_server_that_shows_nothing_new_ends
cell/plant/opcua/commands.py create_task a_call_that_waited_at_a_halted_server_is_refused
cell/plant/handshake/modbus.py GuardedThread a_modbus_server_that_dies_is_a_plc_that_is_away
cell/plant/handshake/adapter.py GuardedThread a_thread_on_which_nothing_depends_is_logged
cell/cli/progress.py GuardedThread a_thread_on_which_nothing_depends_is_logged
cell/wiring/emulated.py GuardedThread a_thread_on_which_nothing_depends_is_logged
cell/records/folder.py ThreadPoolExecutor a_record_that_can_no_longer_be_written_stops_the_arm_too
cell/records/recording/recorder.py GuardedThread poses_that_are_missing_are_noted
cell/records/recording/process.py GuardedThread a_recording_that_cannot_be_ended_is_reported_as_torn
cell/records/recording/writer.py GuardedThread a_file_that_cannot_be_synced_is_told_next
cell/records/recording/uploads.py GuardedThread recordings_that_are_uploaded_no_more_are_noted
cell/records/ledger/outbox.py GuardedThread a_ledger_that_is_written_no_more_is_noted
cell/cli/keyboard.py GuardedThread keys_that_are_read_no_more_are_said
cell/web/watching.py GuardedThread a_page_whose_cell_is_followed_no_more_says_so
cell/web/watching.py GuardedThread a_page_whose_cell_is_followed_no_more_says_so
cell/web/camera.py GuardedThread a_picture_that_is_read_no_more_is_shown_no_more
cell/web/jobs.py GuardedThread jobs_whose_thread_dies_have_failed
cell/web/jobs.py GuardedThread a_job_whose_output_is_read_no_more_ends
cell/web/jobs.py Timer what_does_not_listen_is_ended_by_a_second_cancel
cell/web/guided.py GuardedThread a_calibration_that_is_followed_no_more_ends
cell/web/guided.py GuardedThread a_calibration_that_is_followed_no_more_ends
cell/web/guided.py GuardedThread a_calibration_that_is_to_end_ends
cell/run/cycle.py ThreadPoolExecutor a_computations_exception_is_raised_where_taken
cell/run/filming.py ThreadPoolExecutor a_computations_exception_is_raised_where_taken
cell/cable/swing.py ThreadPoolExecutor a_computations_exception_is_raised_where_taken
cell/computer/forks.py Thread a_computations_exception_is_raised_where_taken
cell/computer/second_process.py ProcessPoolExecutor a_killed_process_is_told_and_replaced
cell/computer/second_process.py Thread it_does_not_outlive_the_first_process
cell/computer/watched.py Thread the_child_does_not_outlive_its_parent
cell/computer/forks.py Thread a_copy_with_a_job_does_not_outlive_its_parent
cell/computer/forks.py Thread an_error_is_that_of_this_process
cell/computer/abilities.py Thread real_time_that_cannot_be_asked_for_is_none
cell/wiring/faults.py Timer every_fault_can_be_caused_and_stands_in_the_docs
drivers/emulators/camera.py GuardedThread a_process_that_is_of_no_use_without_its_thread_ends
drivers/emulators/camera_poses.py GuardedThread a_process_that_is_of_no_use_without_its_thread_ends
drivers/emulators/gripper.py GuardedThread a_process_that_is_of_no_use_without_its_thread_ends
drivers/emulators/camera.py GuardedThread the_end_of_the_stream_is_told_to_the_next_too
drivers/emulators/robotiq.py GuardedThread a_lost_gripper_stops_the_arm
drivers/emulators/urcap.py GuardedThread a_lost_gripper_stops_the_arm
"""


def test_every_thread_and_task_has_its_test() -> None:
    tested = [line.split() for line in TESTED.strip().splitlines()]
    assert Counter((module, kind) for module, kind, _ in tested) == Counter(begun_in_the_program())
    tests = "\n".join(f.read_text(encoding="utf-8") for f in ROOT.glob("tests/**/test_*.py"))
    assert [name for *_, name in tested if f"def test_{name}(" not in tests] == []


def test_every_thread_and_task_is_in_the_table_of_the_docs() -> None:
    page = (ROOT / "docs" / "explain" / "architecture.md").read_text(encoding="utf-8")
    table = page.partition("\n## Threads")[2].partition("\n## ")[0]
    listed = {module: len(threads.split(";")) for module, threads in _ROW.findall(table)}
    modules = (module for module, _ in begun_in_the_program())
    assert listed == Counter(modules)


# --- the rows -------------------------------------------------------------------------------------


def test_a_thread_on_which_nothing_depends_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR, "drivers.threads"):
        GuardedThread("progress", boom, only_logged).run()
    assert caplog.messages == ["the thread progress has ended: ValueError: boom"]


def test_a_computations_exception_is_raised_where_taken() -> None:
    with ThreadPoolExecutor(1) as pool, pytest.raises(ValueError, match="boom"):
        result_of(pool.submit(boom), Commands())
    with pytest.raises((TypeError, AttributeError, PicklingError)):  # what no pipe can carry
        list(stream(boom, [lambda: None], 1))


def test_real_time_that_cannot_be_asked_for_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    assert not abilities._may_run_in_real_time()


def test_a_process_that_is_of_no_use_without_its_thread_ends() -> None:
    program = (
        "import logging, time; from drivers.threads import GuardedThread, end_process\n"
        "logging.getLogger('drivers').addHandler(logging.NullHandler())\n"  # as a command's
        "GuardedThread('door', lambda: 1 / 0, end_process).start(); time.sleep(60)"
    )
    ended = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True)
    assert ended.returncode == 1 and b"ZeroDivisionError" in ended.stderr


def test_a_camera_whose_thread_dies_is_lost() -> None:
    class Clock:
        now_s = staticmethod(time.monotonic)
        sleep_s = staticmethod(time.sleep)

    camera = StreamingCamera(boom, CaptureOptions(0.0), Clock())
    with pytest.raises(ConnectError, match="camera: ValueError: boom"):
        camera.connect()


def test_an_arm_of_which_nobody_knows_who_has_control_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        ur_dashboard, "Dashboard", lambda host: SimpleNamespace(request=lambda _: "")
    )
    pendant = RemoteControl("127.0.0.9")
    dies(pendant._thread)
    child: Any = _Child.__new__(_Child)
    connected = SimpleNamespace(isConnected=lambda: True)
    child._robot = SimpleNamespace(receive=connected, control=connected, unknown=pendant.unknown)
    with pytest.raises(_LostError, match="who has control: ValueError: boom"):
        child._measure(0.0)


def test_inputs_of_an_arm_that_are_heard_no_more_are_lost() -> None:
    lost: list[str] = []
    dies(UrIo("127.0.0.9", [], lambda inputs: None, lost.append, 1.0)._thread)
    assert lost == ["127.0.0.9: ValueError: boom; the handshake must be started again"]


def test_a_modbus_server_that_dies_is_a_plc_that_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ModbusCarrier, "_serve", lambda self: boom())
    carrier = ModbusCarrier(Handshake.model_validate({"port": free_port()}))
    carrier._thread.run()
    with pytest.raises(CarrierError, match="Modbus has ended: ValueError: boom"):
        carrier.read()


def test_keys_that_are_read_no_more_are_said(capsys: pytest.CaptureFixture[str]) -> None:
    dies(Keyboard(boom)._thread)
    assert "keys are read no more: ValueError: boom; Ctrl-C" in capsys.readouterr().err


def test_recordings_that_are_uploaded_no_more_are_noted(tmp_path: Path) -> None:
    uploads = Uploads(boom, tmp_path, "line")
    dies(uploads._thread)
    assert "are uploaded no more: ValueError: boom" in uploads.notes[0]


def test_a_ledger_that_is_written_no_more_is_noted(tmp_path: Path) -> None:
    writer = LedgerWriter(SimpleNamespace(), tmp_path)
    dies(writer._thread)
    assert "none is written any more: ValueError: boom" in writer.notes[0]


def test_poses_that_are_missing_are_noted() -> None:
    notes: list[str] = []
    recorder: Any = SimpleNamespace(note=notes.append, now_s=time.monotonic)
    dies(_PoseStream(recorder, SimpleNamespace(log=boom), 0.0))
    assert notes == ["measured poses are missing from here on: ValueError: boom"]


def test_a_file_that_cannot_be_synced_is_told_next(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "r.mcap", {form.EPOCH: "0"})
    writer._sink.sync = boom  # type: ignore[method-assign]
    writer.sync()
    writer._join()
    with pytest.raises(OSError, match="ValueError: boom"):
        writer.flush()
    writer.abandon()


def test_a_recording_that_cannot_be_ended_is_reported_as_torn(tmp_path: Path) -> None:
    read, write = os.pipe()
    consumer = RingConsumer(SimpleNamespace(), -1, write)  # type: ignore[arg-type]
    consumer._recording = SimpleNamespace(path=tmp_path, end=boom)  # type: ignore[assignment]
    consumer._end(True, True)
    assert json.loads(os.read(read, 4096)) == {"path": str(tmp_path), "error": "ValueError: boom"}
    os.close(read)
    os.close(write)


@pytest.mark.parametrize("thread", ["_publish_loop", "_serve_requests", "_serve_all"])
def test_a_link_that_dies_is_a_cell_that_is_away(
    thread: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rather than one whose state is old, or which does not obey."""
    monkeypatch.setattr(CommandServer if thread == "_serve_all" else Link, thread, boom)
    with Link(tmp_path / "runs", BEGUN, obeys):

        def away() -> bool:
            try:
                Client(tmp_path / "runs").status()
            except LinkError:
                return True
            return False

        wait_until(away)


def test_a_service_without_signs_of_life_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = service_of(tmp_path / "runs", [])
    commands: list[tuple[MachineEvent, str]] = []
    service._cell = SimpleNamespace(  # type: ignore[assignment]
        machine=service._cell.machine, command=lambda *c: commands.append(c)
    )
    monkeypatch.setattr(Service, "_watchdog_loop", boom)
    monkeypatch.setattr(Service, "_wait_for_operator", lambda self: not time.sleep(0.005))
    service.run(lambda result: None)
    assert commands == [
        (MachineEvent.STOP, "nobody tells that the service lives: ValueError: boom")
    ]


def test_an_adapter_that_is_kept_no_more_is_told() -> None:
    told: list[tuple[str, str]] = []
    dies(Adapters({"opcua": ["true"]}, lambda *what: told.append(what))._adapters[0])
    assert told[0][0] == "opcua" and "not started again: ValueError: boom" in told[0][1]


def test_an_mqtt_adapter_that_takes_nothing_ends(tmp_path: Path) -> None:
    told: list[bool] = []
    taker = OutboxFeeder(tmp_path, SimpleNamespace(newest=boom), lambda: told.append(True))  # type: ignore[arg-type]
    with taker:
        wait_until(lambda: told)
    assert str(taker.error) == "ValueError: boom"


@pytest.mark.parametrize("what", ["follow", "show"])
def test_an_opcua_server_that_shows_nothing_new_ends(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fails(self: object) -> None:
        boom()

    monkeypatch.setattr(opcua_server._ViewPublisher, what, boom if what == "follow" else fails)
    settings = settings_with(OpcUa(port=free_port(), folder=tmp_path / "opcua"))

    async def serve() -> None:
        async with opcua_server.running(settings, tmp_path / "runs"):
            await asyncio.sleep(60.0)

    with pytest.raises((asyncio.CancelledError, ValueError)):
        asyncio.run(asyncio.wait_for(serve(), 50.0))


def test_a_page_whose_cell_is_followed_no_more_says_so(tmp_path: Path) -> None:
    client = SimpleNamespace(follow=boom, away=None, heard_s=0.0)
    watch = CellWatch(client, None, tmp_path)  # type: ignore[arg-type]
    watch._state = WatchedState(connected=True, figures=SimpleNamespace())  # type: ignore[arg-type]
    with watch:
        wait_until(lambda: not watch.state.connected and watch.state.figures is None)
    assert watch.state.note == "ValueError: boom"


def test_a_picture_that_is_read_no_more_is_shown_no_more(tmp_path: Path) -> None:
    camera = LiveCamera(tmp_path, iter([0.0]).__next__)  # the second look at the clock raises
    camera.newest = SimpleNamespace()  # type: ignore[assignment]
    camera.ask()
    wait_until(lambda: camera.newest is None)
    assert not camera._reading


def test_jobs_whose_thread_dies_have_failed() -> None:
    with Jobs(boom) as jobs:
        assert jobs.submit(task("pass"), "Ada") == ""
        wait_until(lambda: newest(jobs).state is JobState.FAILED)
        assert newest(jobs).output == ("ValueError: boom",)


def test_a_job_whose_output_is_read_no_more_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Jobs, "_read_printed", boom)
    processes = []

    def start(words: Sequence[str]) -> subprocess.Popen[str]:
        processes.append(started(words))
        return processes[0]

    with Jobs(start) as jobs:
        assert jobs.submit(task("import time; time.sleep(60)"), "Ada") == ""
        wait_until(lambda: newest(jobs).state is JobState.FAILED)
    [process] = processes
    assert process.stdout is not None and process.stdout.closed


@pytest.mark.parametrize("what", ["_follow", "_read_output"])
def test_a_calibration_that_is_followed_no_more_ends(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Guided, what, boom)
    guided = Guided()
    assert guided.start("calibrate", [sys.executable, "-c", "import time; time.sleep(60)"]) == ""
    wait_until(lambda: not guided.state.runs)
    assert "ValueError: boom" in guided.state.output and guided.state.code != 0


def test_a_calibration_that_is_to_end_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guided_module, "_killed_later", boom)
    guided = Guided()
    stubborn = "import signal, time; signal.signal(15, signal.SIG_IGN); print(); time.sleep(60)"
    guided.start("calibrate", [sys.executable, "-u", "-c", stubborn])
    wait_until(lambda: guided.state.output or guided._process)
    assert guided.cancel() == ""
    wait_until(lambda: not guided.state.runs)
