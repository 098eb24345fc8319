"""The paper's cable and motion; and options for a cell that is really there."""

from __future__ import annotations

import gc
import itertools
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.cli.logs import PACKAGES
from drivers.priority import session_nice, set_session_nice
from tools.worlds.made_studies import moved

HARDWARE = "hardware"
#: Rooms of tests in which devices run in real time, as do tests that want to run alone.  A busy
#: computer can upset these, and only these are tried again.
REAL_TIME = (
    "drivers/conformance",
    "drivers/emulators",
    "drivers/test_genicam_camera",
    "drivers/test_opencv_camera",
    "drivers/test_serial_gripper",
    "drivers/test_ur",  # and the gripper behind its URCap
    "end_to_end/test_hardware",  # which runs a few of the conformance suite
)


# how long an example takes is this computer's affair, not the code's; the examples of `make test`
# are always the same, and CELL_EXPLORE=1 looks for others
settings.register_profile(
    "untimed",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=not os.environ.get("CELL_EXPLORE"),
    print_blob=True,
)
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def no_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy computer a command takes more than the ten seconds after which it speaks."""
    monkeypatch.setattr("cell.cli.progress.EVERY_S", 1e6)


@pytest.fixture(autouse=True)
def no_precedence() -> Iterator[None]:
    """A cell with real devices goes before others on its computer: no longer than its test.

    Processes in sessions of their own, such as jobs of the pages, would starve for the rest.
    """
    usual = os.getpriority(os.PRIO_PROCESS, 0)
    yield
    if os.getpriority(os.PRIO_PROCESS, 0) != usual:
        os.setpriority(os.PRIO_PROCESS, 0, usual)
    with suppress(OSError, ValueError):
        if session_nice() < 0:
            set_session_nice(0)


@pytest.fixture(autouse=True)
def no_log_to_streams() -> Iterator[None]:
    """What a command logs here goes to the streams of its test, which are closed after it."""
    yield
    for name in PACKAGES:
        logger = logging.getLogger(name)
        for handler in [h for h in logger.handlers if type(h) is logging.StreamHandler]:
            logger.removeHandler(handler)


@pytest.fixture(scope="session", autouse=True)
def no_forks_of_the_lab() -> Iterator[None]:
    """Beside other processes of the tests the lab makes no forks: no core is free for them.

    What it finds is the same, which tests/cell/lab/search says; commands in processes of their own
    have all cores.
    """
    with pytest.MonkeyPatch.context() as patch:
        if "PYTEST_XDIST_WORKER" in os.environ:
            for module in ("data.work", "strength.limits"):
                patch.setattr(f"cell.lab.{module}.threads", lambda: 1)
        yield


@pytest.fixture(scope="session")
def free_loopback() -> Callable[[], str]:
    """Addresses of this computer that nobody else uses."""
    numbers = itertools.count(2)
    worker = os.getpid() % 60000
    return lambda: f"127.{1 + worker // 250}.{1 + worker % 250}.{next(numbers)}"


@pytest.fixture
def cable() -> Cable:
    return Cable(0.1, 0.0074, 0.016, 1e-4)


@pytest.fixture
def arc() -> np.ndarray:
    return np.linspace(0.0, 0.1, 11)


@pytest.fixture
def jerk() -> Motion:
    """50 mm down in 0.3 s, least jerk, sampled at 500 Hz."""
    return moved(np.arange(0.0, 0.8, 0.002), (0.0, -0.05), 0.3, begin_s=0.1)


@pytest.fixture
def at_rest() -> Callable[..., np.ndarray]:
    """(markers, 2) shape of a cable held still at a clamp angle, relative to its gripping point."""

    def shape(
        model: CableModel,
        arc_length_m: np.ndarray,
        angle_rad: float = 0.0,
        segments: int | None = None,
    ) -> np.ndarray:
        still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.full(2, angle_rad))
        solver = Solver() if segments is None else Solver(segments=segments)
        return simulate(model, still, np.zeros(1), arc_length_m, solver=solver)[0, 0]

    return shape


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--spare-time",
        action="store_true",
        help="take only the processor's time that no other process wants",
    )
    parser.addoption(
        "--budget",
        type=float,
        metavar="SECONDS",
        help="skip what has not begun after so many seconds; the first files are the nearest",
    )
    group = parser.getgroup("devices that are really there")
    group.addoption(
        "--hardware",
        action="store_true",
        help="run the conformance suite on the devices of --config, and nothing else: they move",
    )
    group.addoption("--config", type=Path, help="settings of the cell for --hardware")


def _hear_signals() -> None:
    """Signals ignored by whoever started the tests (`nohup`, `&`) are heard by what they start."""
    for number, usual in (
        (signal.SIGINT, signal.default_int_handler),
        (signal.SIGHUP, signal.SIG_DFL),
    ):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, usual)


def _give_way() -> None:
    """From now on this process and those that it starts run when a processor would be idle."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(19)


class _AtOnce:
    """Says what failed as soon as it fails: a run that is ended from outside has no last page."""

    def __init__(self, terminal: pytest.TerminalReporter) -> None:
        self._terminal = terminal

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._terminal.write_line(f"\n{report.nodeid}, {report.when}: {report.longreprtext}")


_BEGUN_S = time.monotonic()


def pytest_runtest_setup(item: pytest.Item) -> None:
    budget_s = item.config.getoption("--budget")
    if budget_s is not None and time.monotonic() - _BEGUN_S > budget_s:
        pytest.skip(f"not within {budget_s:g} s")


def pytest_configure(config: pytest.Config) -> None:
    _hear_signals()
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    if terminal is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_AtOnce(terminal))
    if config.getoption("--spare-time"):
        _give_way()
    if config.getoption("--hardware") != (config.getoption("--config") is not None):
        raise pytest.UsageError("--hardware and --config FILE go together")
    if config.getoption("--hardware") and not config.getoption("--collect-only"):
        _own_devices(config)


def _own_devices(config: pytest.Config) -> None:
    """Hold the devices to the end of the tests; ends with 2 where another program commands them."""
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.wiring.ownership import owned

    path = config.getoption("--config")
    owning = owned(load_settings(path), path)
    try:
        owning.__enter__()
    except InputError as error:
        pytest.exit(str(error), 2)
    config.add_cleanup(lambda: owning.__exit__(None, None, None))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """All that is collected stays to the end: it need not be looked through for garbage.

    That took a fifth of the collection's time, and more while the tests ran.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def _longest_first(items: list[pytest.Item]) -> None:
    """Pages of docs and tests in a browser take up to a minute: all would wait for a late one.

    Of `pytest -n` each process begins with a part of the tests: the first one with the docs, the
    last one with the browser's.
    """
    kinds: dict[str, list[pytest.Item]] = {"docs": [], "browser": [], "": []}
    for item in items:
        browser = item.path.match("end_to_end/test_web*.py")
        kinds["docs" if "docs" in item.path.parts else "browser" if browser else ""].append(item)
    last = len(items) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    ordered = kinds["docs"] + kinds[""]
    at = len(items) - last
    items[:] = ordered[:at] + kinds["browser"] + ordered[at:]


@pytest.hookimpl(tryfirst=True)  # before `-m` selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    _longest_first(items)
    if not config.getoption("--hardware"):
        for item in items:
            room = item.path.relative_to(Path(__file__).parent).as_posix()
            if room.startswith(REAL_TIME):
                item.add_marker(pytest.mark.real_time)
            if item.get_closest_marker("real_time") is None:
                continue
            if not room.startswith(("end_to_end/", "drivers/")):
                raise pytest.UsageError(
                    f"{item.nodeid}: `make tests` runs alone what is in end_to_end and drivers"
                )
            item.add_marker(pytest.mark.flaky(reruns=2, reruns_delay=1))
        return
    on_hardware = [
        item
        for item in items
        if isinstance(item, pytest.Function)
        and hasattr(item, "callspec")
        and HARDWARE in item.callspec.params.values()
    ]
    others = [item for item in items if item not in set(on_hardware)]
    config.hook.pytest_deselected(items=others)
    items[:] = on_hardware
