"""The measurements come to their end: what fails or falls behind is named."""

from __future__ import annotations

import inspect
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.interfaces import CameraError, Frame
from tools.bench import bench, bench_servo, bench_wait


@pytest.fixture(autouse=True)
def nothing_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "_MISSED", [])


def wait(wait_s: float, stall_s: float) -> bench_wait.Wait:
    return bench_wait.Wait("inserted", wait_s, 0.0, 0.3, 0.008, 1.0, stall_s)


def test_waits_are_judged_beside_the_computers_own_stalls(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was called with an argument too few, and ended all the measurements."""
    signature = inspect.signature(bench_wait.waits)

    def waits(*arguments, **named):
        asked = signature.bind(*arguments, **named).arguments
        assert asked["burners"] == 0
        return [wait(0.070, 0.050)] * asked["cycles"]

    monkeypatch.setattr(bench_wait, "waits", waits)
    bench.waiting()
    said = capsys.readouterr().out
    assert "beyond the computer's own stall: 20 " in said
    assert bench._MISSED == ["milliseconds, 95 % of them"]


def test_the_processor_time_of_an_ended_process_counts() -> None:
    """It vanished: a hold within which a recording was finished took less than nothing."""
    burn = "import time\nwhile time.process_time() < 0.3: pass\ninput()"
    before_s = bench_wait.cpu_s()
    child = subprocess.Popen([sys.executable, "-c", burn], stdin=subprocess.PIPE)
    while bench_wait.cpu_of(child.pid) < 0.3:
        time.sleep(0.01)
    child.communicate(b"\n")
    assert bench_wait.cpu_s() - before_s >= 0.29
    assert bench_wait.cpu_of(child.pid) == 0.0


def test_a_part_that_fails_does_not_end_the_others(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise RuntimeError("no emulator")

    done: list[str] = []
    monkeypatch.setattr(bench, "linear_cost", fail)
    monkeypatch.setattr(bench, "plug_in", lambda: done.append("plugin"))
    monkeypatch.setattr(sys, "argv", ["bench.py", "linear", "plugin"])
    assert bench.main() == 1
    assert done == ["plugin"]
    said = capsys.readouterr()
    assert "missed: linear, which failed" in said.out
    assert "no emulator" in said.err


class SlowCamera:
    """Refuses its first connection, breaks its first recording off, then gives three frames."""

    def __init__(self) -> None:
        self.connected = self.started = 0
        self._left = 0

    def connect(self) -> None:
        self.connected += 1
        if self.connected == 1:
            raise CameraError("camera", "slow or uneven: 40 Hz measured, 60 Hz expected", "")

    def close(self) -> None:
        self._left = 0

    def start(self, frame_count: int) -> None:
        self.started += 1
        self._left = 3

    def stop(self) -> None:
        self._left = 0

    def read(self) -> Frame | None:
        if self.started == 1:
            raise CameraError("camera", "the stream of pictures ended", "")
        if not self._left:
            return None
        self._left -= 1
        return Frame(0, 0.0, np.zeros((2, 2), dtype=np.uint8))


def test_an_emulated_camera_that_falls_behind_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SlowCamera()
    watcher = bench_servo._Watcher(camera, None, None)
    monkeypatch.setattr(bench_servo, "detect", lambda *_: SimpleNamespace(seen=True))
    clock = SimpleNamespace(monotonic=lambda: float(watcher.frames))
    monkeypatch.setattr(bench_servo, "time", clock)
    watcher.watch(3.0)
    assert watcher.frames == 3
    assert [said.split(":")[0] for said in watcher.troubles] == ["camera", "camera"]
    assert camera.connected == 3


@pytest.mark.parametrize(("pass_s", "missed"), [(0.0105, 0), (0.014, 2)])
def test_a_pass_is_judged_by_what_its_simulations_cost_in_the_same_run(
    monkeypatch: pytest.MonkeyPatch, pass_s: float, missed: int
) -> None:
    """A bar in milliseconds failed on computers that were slower, or busy."""
    monkeypatch.setattr(bench, "best_of", lambda *_, **__: [pass_s, 0.0095])
    bench.gauss_newton_pass()
    assert len(bench._MISSED) == missed
