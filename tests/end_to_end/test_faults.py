"""Whatever happens in whatever step: the arm comes to rest, and the record says what and where."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cell.files.atomic import write_atomic
from cell.records.folder import read_record
from cell.records.result import Outcome, Result
from cell.run.machine import CellState, EventRefusedError, MachineEvent
from cell.run.plans import INSERTING
from drivers.interfaces import ArmMode
from drivers.sim.arm import ArmFaults
from drivers.sim.camera import CameraFaults
from drivers.sim.gripper import GripperFaults

Live = Callable[..., SimpleNamespace]

#: Steps during which the gripper moves, and those after which there is something measured.
KNOWS_STUDY = INSERTING.names[INSERTING.names.index("check_clocks") :]
KNOWS_MODEL = INSERTING.names[INSERTING.names.index("simulate") :]


def check_stopped(it: SimpleNamespace, result: Result, step: str) -> None:
    """The arm rests, the jaws are as they were, and the record is readable and complete."""
    assert result.outcome is Outcome.FAILED
    assert result.fault is not None and result.fault.step == step
    world = it.twins.world
    resting = world.gripper_pose()
    assert world.gripper_rest_from_s() <= world.clock.now_s()
    world.clock.sleep_s(5.0)
    assert world.gripper_pose() == resting
    read = read_record(Path(result.folder))
    assert read.closed and read.result == result and read.step == step
    assert (read.study is not None) is (step in KNOWS_STUDY)
    assert (read.model is not None) is (step in KNOWS_MODEL)
    assert set(result.seconds) <= set(INSERTING.names[: INSERTING.names.index(step) + 1])


def interrupt(it: SimpleNamespace) -> None:
    raise KeyboardInterrupt


def stop_from_another_thread(it: SimpleNamespace) -> None:
    thread = threading.Thread(target=it.cell.command, args=(MachineEvent.STOP, "guard opened"))
    thread.start()
    thread.join(30)
    assert not thread.is_alive()


def lose_the_arm(it: SimpleNamespace) -> None:
    it.twins.arm.faults = ArmFaults(lost_at_s=it.twins.world.clock.now_s())


SOME = ("reset", "lower", "hold_and_capture", "execute", "go_home")


@pytest.mark.parametrize(
    ("step", "act", "cause"),
    [(step, stop_from_another_thread, "guard opened") for step in INSERTING.names]
    + [(step, interrupt, "interrupted by a person") for step in SOME],
)
def test_a_stop_in_any_step_and_an_interruption_end_stopped(
    live: Live, step: str, act: Callable[[SimpleNamespace], None], cause: str
) -> None:
    it = live({step: act})
    result = it.cell.run_cycle(1)
    check_stopped(it, result, step)
    assert result.fault is not None and result.fault.cause == cause
    assert it.cell.machine.state is CellState.STOPPED


@pytest.mark.parametrize("step", ["start", "lower", "hold_and_capture", "execute", "go_home"])
def test_a_lost_arm_ends_aborted(live: Live, step: str) -> None:
    it = live({step: lose_the_arm})
    result = it.cell.run_cycle(1)
    check_stopped(it, result, step)
    assert result.fault is not None and result.fault.device == "arm"
    assert "then reset" in result.fault.remedy
    assert it.cell.machine.state is CellState.ABORTED
    assert read_record(Path(result.folder)).state["arm"] == ArmMode.LOST.value


def test_a_stop_in_the_middle_of_a_motion_does_not_wait_for_its_end(live: Live) -> None:
    def soon(it: SimpleNamespace) -> None:
        clock = it.twins.world.clock
        clock.call_at(
            clock.now_s() + 0.5, lambda: it.cell.command(MachineEvent.ABORT, "e-stop pressed")
        )

    it = live({"execute": soon})
    result = it.cell.run_cycle(1)
    check_stopped(it, result, "execute")
    assert result.seconds["execute"] < 0.6
    assert it.twins.world.gripper_pose().x_m > -0.049, "stopped short of the end of the stroke"
    assert it.cell.machine.state is CellState.ABORTED
    assert it.twins.world.holds, "a stop releases nothing"


DEVICE_FAULTS = [
    ("connect", "camera", CameraFaults(refuses_to_connect=True), "no camera answers"),
    ("connect", "gripper", GripperFaults(refuses_to_connect=True), "does not answer"),
    ("connect", "arm", ArmFaults(refuses_to_connect=True), "refuses the connection"),
    ("start", "arm", ArmFaults(local_control=True), "local control"),
    ("reset", "arm", ArmFaults(reduced_speed=True), "reports reduced_speed"),
    ("start", "arm", ArmFaults(reduced_speed=True), "is in reduced speed"),
    ("grasp", "gripper", GripperFaults(misses=True), "nothing between the jaws"),
    ("grasp", "gripper", GripperFaults(jams=True), "did not come to rest"),
    ("lower", "camera", CameraFaults(missing_frames=frozenset({20})), "was due"),
    ("hold_and_capture", "camera", CameraFaults(frozen_from=40), "the camera is frozen"),
    ("hold_and_capture", "camera", CameraFaults(late_from=10, late_s=1.0), "s late, allowed"),
]


@pytest.mark.parametrize(
    ("step", "device", "faults", "cause"), DEVICE_FAULTS, ids=[f[3] for f in DEVICE_FAULTS]
)
def test_a_device_that_fails_is_named_with_its_cause(
    live: Live, step: str, device: str, faults: object, cause: str
) -> None:
    it = live({step: lambda it: setattr(getattr(it.twins, device), "faults", faults)})
    result = it.cell.run_cycle(1)
    check_stopped(it, result, step)
    assert result.fault is not None
    assert result.fault.device == device and cause in result.fault.cause
    assert result.fault.remedy


def test_a_cable_that_falls_out_of_the_jaws_is_noticed_before_anything_is_identified(
    live: Live,
) -> None:
    def slip(it: SimpleNamespace) -> None:
        at_s = it.twins.world.clock.now_s() + 0.3
        it.twins.gripper.faults = GripperFaults(slips_at_s=at_s)

    it = live({"lower": slip})
    result = it.cell.run_cycle(1)
    check_stopped(it, result, "hold_and_capture")
    assert result.fault is not None and result.fault.cause == "lost the cable"


def test_a_mistake_of_the_program_is_a_fault_with_its_traceback(live: Live) -> None:
    def mistake(it: SimpleNamespace) -> None:
        raise ZeroDivisionError("by mistake")

    it = live({"execute": mistake})
    result = it.cell.run_cycle(1)
    check_stopped(it, result, "execute")
    assert result.fault is not None and result.fault.cause == "ZeroDivisionError: by mistake"
    assert "in mistake" in read_record(Path(result.folder)).state["traceback"]


def test_nothing_moves_after_a_fault_until_a_person_acknowledges_it(live: Live) -> None:
    def miss(it: SimpleNamespace) -> None:
        it.twins.gripper.faults = GripperFaults(misses=True)

    it = live({"grasp": miss})
    assert it.cell.run_cycle(1).outcome is Outcome.FAILED
    with pytest.raises(EventRefusedError, match="no cycle can begin while aborted"):
        it.cell.run_cycle(2)
    assert len(list(it.runs.iterdir())) == 1
    it.twins.gripper.faults = GripperFaults()
    it.cell.acknowledge()
    assert it.cell.run_cycle(2).outcome is Outcome.INSERTED


def test_a_stop_given_between_cycles_is_not_lost(live: Live) -> None:
    it = live()
    it.cell.command(MachineEvent.STOP, "not now")
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.FAILED
    assert result.fault is not None and result.fault.cause == "not now"
    assert it.twins.world.waiting == 1, "no cable was taken"


def test_a_full_disk_ends_the_cycle_with_a_closed_record_that_says_where_the_cable_is(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    def disk_full(it: SimpleNamespace) -> None:
        """Nothing can be written any more, but into room that is freed."""
        (folder,) = it.runs.iterdir()

        def write(path: Path, content: str | bytes) -> None:
            if (folder / "reserve").exists() or len(content) > 60_000:
                raise OSError(errno.ENOSPC, "No space left on device")
            write_atomic(path, content)

        def write_each(files: Mapping[Path, str | bytes], **_: object) -> None:
            for path, content in files.items():
                write(path, content)

        monkeypatch.setattr("cell.records.folder.write_atomic", write)
        monkeypatch.setattr("cell.study.folder.write_all", write_each)

    it = live({"hold_and_capture": disk_full})
    result = it.cell.run_cycle(1)
    assert result.outcome is Outcome.FAILED and result.fault is not None
    assert result.fault.cause.startswith("the record cannot be written: No space left on device: ")
    assert result.fault.remedy == "make room there, or mend the disk"
    assert result.fault.cable == "a cable is in the jaws"
    (folder,) = it.runs.iterdir()
    record = read_record(folder)
    assert record.closed and record.result == result
    assert (record.state["state"], record.state["cable"]) == ("aborted", "a cable is in the jaws")
    assert not (folder / "reserve").exists()
    assert it.cell.machine.state is CellState.ABORTED


def test_a_record_that_can_no_longer_be_written_stops_the_arm_too(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: str | bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    def disk_gone(it: SimpleNamespace) -> None:
        monkeypatch.setattr("cell.records.folder.write_atomic", full)

    it = live({"lower": disk_gone})
    result = it.cell.run_cycle(1)
    assert result.fault is not None and "the record cannot be written" in result.fault.cause
    assert it.twins.world.gripper_rest_from_s() <= it.twins.world.clock.now_s()
    assert it.cell.machine.state is CellState.ABORTED
    assert it.twins.arm.state().mode is ArmMode.STOPPED


@pytest.mark.parametrize(
    ("step", "break_it", "mend_it"),
    [
        (
            "lower",
            lambda it: setattr(it.twins.arm, "faults", ArmFaults(lost_at_s=now_s(it) + 0.3)),
            lambda it: setattr(it.twins.arm, "faults", ArmFaults()),
        ),
        (
            "execute",
            lambda it: setattr(it.twins.camera, "faults", CameraFaults(lost_at_s=now_s(it) + 0.3)),
            lambda it: setattr(it.twins.camera, "faults", CameraFaults()),
        ),
    ],
)
def test_a_device_that_was_lost_is_connected_anew_and_the_next_cycle_works(
    live: Live,
    step: str,
    break_it: Callable[[SimpleNamespace], None],
    mend_it: Callable[[SimpleNamespace], None],
) -> None:
    it = live({step: break_it}, cycles=2)
    assert it.cell.run_cycle(1).outcome is Outcome.FAILED
    mend_it(it)
    it.cell.acknowledge()
    it.steps.clear()
    assert it.cell.run_cycle(2).outcome is Outcome.INSERTED
    assert it.steps[0] == "connect"
    assert "check_clocks" in it.steps  # a camera's clock may begin anew with it


def now_s(it: SimpleNamespace) -> float:
    time_s: float = it.twins.world.clock.now_s()
    return time_s


def test_a_computer_that_is_too_slow_gives_up_and_says_so(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.run.steps.is_past", lambda bench, t_s: True)
    it = live()
    result = it.cell.run_cycle(1)
    check_stopped(it, result, "choose")
    assert result.fault is not None and result.fault.device == "computer"
    assert "longer than the" in result.fault.cause and "decide_s" in result.fault.remedy


def test_a_second_process_that_cannot_begin_is_named_with_the_remedy(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken(ThreadPoolExecutor):
        def submit(self, *args: object, **kwargs: object) -> Future[Any]:
            job: Future[Any] = Future()
            job.set_exception(BrokenExecutor("ended abruptly"))
            return job

    monkeypatch.setattr("cell.run.cycle.ThreadPoolExecutor", Broken)
    result = live().cell.run_cycle(1)
    assert result.outcome is Outcome.FAILED
    assert result.fault is not None
    assert (result.fault.device, result.fault.step) == ("computer", "warm_up")
    assert "free memory" in result.fault.remedy


def test_a_hold_while_suspended_lasts_when_the_suspension_ends(live: Live) -> None:
    """It was forgotten until the next motion had been made."""
    states: list[CellState] = []
    it = live({"grasp": lambda it: it.cell.command(MachineEvent.SUSPEND)})

    def on_change(state: CellState) -> None:
        states.append(state)
        if state is CellState.SUSPENDED:
            it.cell.command(MachineEvent.HOLD)
            it.cell.command(MachineEvent.UNSUSPEND)
        if state is CellState.HELD:
            assert it.steps[-1] == "suspended"
            it.cell.command(MachineEvent.UNHOLD)

    it.cell.machine.on_change = on_change
    assert it.cell.run_cycle(1).outcome is Outcome.INSERTED
    assert CellState.HELD in states
