"""A second program for one cell's devices is refused, whatever the first is doing; never two.

MASTERS_TRIES = tries of a second master in each state of the first; 1 in CI.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cell.plant.client import Client
from cell.plant.messages import Notice, Request, Status
from cell.run.machine import MachineEvent
from cell.settings import load_settings
from cell.wiring.emulated import EmulatedCell

from .conftest import unrecorded
from .forked import Forked, Forking
from .test_service import in_step, until, waits_for

pytestmark = pytest.mark.real_time

TRIES = int(os.environ.get("MASTERS_TRIES", "1"))

PRODUCTS = """
products:
  short: {}
  long: {}
product: short
"""


@pytest.fixture(scope="module")
def config(light_config: Path) -> Path:
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
    config = light_config.with_name("masters.yaml")
    shutil.copy(light_config, config)
    with unrecorded(config).open("a", encoding="utf-8") as file:
        file.write(PRODUCTS)
    before, view, after = re.split(r"\n  view: (.*)", light_config.read_text(encoding="utf-8"))
    after = after.replace(
        "\nworld:", f"\ncalibration: {{folder: {config.parent}}}\n\nworld:\n  camera: {view}\n#"
    )
    to_calibrate(config).write_text(before + after, encoding="utf-8")
    return config


def to_calibrate(config: Path) -> Path:
    """The same cell, which is to be calibrated."""
    return config.with_name("calibrated.yaml")


@pytest.fixture(scope="module")
def emulated(config: Path) -> Iterator[EmulatedCell]:
    with EmulatedCell(load_settings(config), seed=1) as emulated:
        yield emulated


Begin = Callable[..., Forked]


@pytest.fixture
def begin(forking: Forking, config: Path, tmp_path: Path) -> Iterator[Begin]:
    """Begin a command on the cell, with records of its own."""
    begun: list[Forked] = []

    def begin(*words: str, out: str = "") -> Forked:
        folder = (
            ("--runs", str(tmp_path / (out or f"runs{len(begun)}"))) if words[0] == "run" else ()
        )
        of = to_calibrate(config) if words[0] == "calibrate" else config
        begun.append(forking.start(*words, "--config", of, *folder))
        return begun[-1]

    yield begin
    for process in begun:
        process.kill()
        process.wait()


def programs(emulated: EmulatedCell) -> list[str]:
    """What became of programs on the controller."""
    events = [e["what"] for e in emulated.controller.request("state")["events"]]
    return [what for what in events if what.startswith("program")]


def or_lost(reached: Callable[[Notice | Status], bool]) -> Callable[[Notice | Status], bool]:
    """A computer that is too busy loses the arm, which is the first's all the same."""
    return lambda said: reached(said) or waits_for("acknowledgement")(said)


SECONDS = (
    ("run",),
    ("run", "--dry-run"),
    ("run", "--product", "long"),
    ("run", "--cycles", "forever"),
    ("calibrate", "camera", "--dialogue"),  # as the pages do
)


def test_a_second_master_is_refused_in_every_state_of_the_first(
    emulated: EmulatedCell, begin: Begin, tmp_path: Path
) -> None:
    first = begin("run", "--cycles", "forever", "--product", "short", out="first")
    tried = 0

    def try_second() -> None:
        nonlocal tried
        others = [begin(*SECONDS[(tried + k) % len(SECONDS)]) for k in range(TRIES)]
        tried += TRIES
        for second in others:
            _, said = second.communicate()
            assert second.returncode == 2, said
            assert f"in use by process {first.pid}, since".encode() in said, said

    client = Client(tmp_path / "first").connect(wait_s=60.0)
    for step in ("warm_up", "connect"):
        until(client, in_step(step))
        try_second()
    until(client, or_lost(waits_for("start")))
    try_second()
    client.send(Request(MachineEvent.START, "Ada"))
    until(client, or_lost(in_step("lower")))
    client.send(Request(MachineEvent.HOLD, "Ada"))
    try_second()
    until(client, or_lost(waits_for("unhold")))
    try_second()
    client.send(Request(MachineEvent.STOP, "Ada"))
    until(client, waits_for("acknowledgement"))
    try_second()
    assert "program ended: replaced by another program" not in programs(emulated)


def test_a_killed_masters_devices_are_taken_over_when_its_arm_is_stopped(
    emulated: EmulatedCell, begin: Begin, tmp_path: Path
) -> None:
    for number in range(TRIES):
        name = f"killed{number}"
        first = begin("run", "--cycles", "forever", out=name)
        client = Client(tmp_path / name).connect(wait_s=60.0)
        until(client, or_lost(waits_for("start")))
        client.send(Request(MachineEvent.START, "Ada"))
        until(client, or_lost(in_step("lower")))
        first.kill()
        second = begin("run", "--cycles", "forever", out=f"next{number}")
        connected = or_lost(waits_for("start"))
        until(Client(tmp_path / f"next{number}").connect(wait_s=60.0), connected)
        happened = programs(emulated)
        assert "program ended: replaced by another program" not in happened
        for before, after in itertools.pairwise(happened):
            assert {before, after} != {"program started"}, happened  # one at a time
        second.kill()
        second.wait()
