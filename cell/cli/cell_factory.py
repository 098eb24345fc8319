"""The cell of a run: built from settings and options, changed between products.

It is connected to the plant by its link, and by the service of `--cycles forever`.
"""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from cell.cli.shared import handled
from cell.files.input_error import InputError
from cell.plant.children import Adapters, command_of
from cell.plant.link import Handler, Link
from cell.plant.messages import COMMANDS, CommandReply, Request, Status
from cell.plant.reporter import LATCHED, Reporter, latch, refusal
from cell.plant.service import Service
from cell.plant.wire import LinkError
from cell.records.result import Result
from cell.run.machine import MachineEvent
from cell.run.plans import Plan
from cell.settings.model import Settings
from cell.settings.provenance import calibration_hash, line_name
from cell.settings.translate import model_hash

if TYPE_CHECKING:
    from cell.run.cycle import Cell
    from cell.run.station import ProductTask
    from cell.settings.calibrated import Calibrated
    from cell.wiring.twins import Twins

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Products:
    """All products that a cell can make, by name in the order of the file; may be empty.

    default       settings of the file
    settings      of each product
    calibrations  of each product
    usual         default product; None = a product must be named
    """

    default: Settings
    settings: Mapping[str, Settings] = field(default_factory=dict)
    calibrations: Mapping[str, Calibrated] = field(default_factory=dict)
    usual: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the file."""
        return tuple(self.settings)

    @property
    def patterns(self) -> Mapping[str, str | None]:
        """Which ids their parts have; None = any."""
        return {name: product.part_ids for name, product in self.default.products.items()}

    def chosen(self, requested: str | None, part: str | None) -> str | None:
        """Product of a part, by `product_for`; None without products."""
        from cell.settings.product import product_for

        return product_for(self.patterns, requested, part, self.usual)


def _with_whole_frames(settings: Settings, config: Path) -> Settings:
    if settings.recording is None:
        message = "says `recording: null`: nothing is recorded; leave out --whole-frames"
        raise InputError.at(config, message)
    recording = settings.recording.model_copy(update={"whole_frames": True})
    return settings.model_copy(update={"recording": recording})


def products_in(config: Path, product: str | None, whole_frames: bool = False) -> Products:
    """The products of a settings file, with their calibrations.

    product       default product, in place of the file's
    whole_frames  record full frames
    raises        InputError: settings or calibrations are wrong, or there is no such product;
                  full frames are requested but nothing is recorded
    """
    from cell.settings import load_settings
    from cell.settings.calibrated import calibrated
    from cell.settings.loading import load_product, products_of

    base = load_settings(config)
    if whole_frames:
        base = _with_whole_frames(base, config)
    if product is not None:
        load_product(config, product)
    settings = products_of(base)
    known = {name: calibrated(of, config) for name, of in settings.items()}
    usual = product or (base.product if settings else None)
    return Products(base, settings, known, usual)


@dataclass(frozen=True, eq=False)
class BuiltCell:
    """A cell, and the tasks that it needs to change to another product."""

    cell: Cell
    products: Products
    tasks: Mapping[str, ProductTask] = field(default_factory=dict)
    twins: Twins | None = None

    def change_product(self, name: str) -> None:
        """Make the next cycles of a product; the cables of a simulated world are its own, too."""
        if name == self.cell.product:
            return
        self.cell.change_product(self.tasks[name])
        if self.twins is not None:
            self.twins.make(self.products.settings[name])


def build_cell(
    products: Products,
    first: str | None,
    known: Calibrated,
    out: Path,
    *,
    seed: int,
    cycles: int | None,
    on_step: Callable[[int, str], None],
) -> BuiltCell:
    """Build a cell for its first product, or for settings without products; not connected.

    first   None = without products
    known   calibration of the first product
    cycles  number of simulated cables; None = unlimited
    """
    from cell.settings.devices import SimulatedArm
    from cell.wiring.build import build_cell, product_task
    from cell.wiring.twins import build_twins

    settings = products.default if first is None else products.settings[first]
    tasks = {n: product_task(s, products.calibrations[n]) for n, s in products.settings.items()}
    twins = None
    if isinstance(settings.arm, SimulatedArm):
        several = len(tasks) > 1 and cycles != 0
        twins = build_twins(settings, seed, None if several else cycles, known)
    others = tuple(tasks[name].task for name in tasks if name != first)
    cell = build_cell(
        settings,
        out,
        seed=seed,
        cycles=cycles,
        on_step=on_step,
        calibration=known,
        twins=twins,
        others=others,
    )
    return BuiltCell(cell, products, tasks, twins)


class PlantEnd:
    """Lets other programs observe and command a cell while it runs."""

    def __init__(self, made: BuiltCell, runs: Path, settings: Settings) -> None:
        self._made = made
        self._cell = made.cell
        self._runs = runs
        self._settings = settings
        self._service: Service | None = None
        self.reporter = Reporter(lambda kind, data: None)

    def step(self, number: int, step: str) -> None:
        """A step begins: for the cell's `on_step`."""
        if self._service is not None:
            self._service.step(number, step)
        else:
            self.reporter.step(number, step)

    @contextmanager
    def reachable(self) -> Iterator[None]:
        """A run of a fixed number of cycles: it can be observed and held, and takes no starts.

        If the socket cannot be made, or a different cell has it, the run continues without it.
        """
        link = self._link(self._answer, LATCHED)
        self._report_to(link)
        self._cell.machine.on_change = self.reporter.state
        self._cell.waited = self.reporter.take_waited
        with ExitStack() as opened:
            try:
                opened.enter_context(link)
            except LinkError as error:
                _LOG.warning("%s", error)
            yield

    def serve(self, plan: Plan, on_result: Callable[[Result], None], config: Path) -> bool:
        """Make cycles on request until SIGTERM; whether Ctrl-C stopped a running cycle.

        config  the settings' file, for the adapters that it lets start
        raises  LinkError: another cell runs there already; InputError; RecordError
        """
        link = self._link(lambda request: service.answer(request), COMMANDS)
        stopped = False

        def tell(result: Result) -> None:
            nonlocal stopped
            on_result(result)
            if interrupted(result):
                stopped = True
                raise KeyboardInterrupt

        self._report_to(link)
        products = self._made.products
        service = Service(
            self._cell,
            self.reporter,
            self._runs,
            plan=plan,
            products=products.patterns,
            product=products.usual,
            select_product=self._made.change_product,
        )
        self._service = service
        ended = handled(lambda *_: service.end(), signal.SIGTERM)  # after the cycle under way
        with closing(self._adapters(config)) as adapters, link, ended:
            adapters.start()
            try:
                service.run(tell, self._tell_ready)
            except KeyboardInterrupt:
                return stopped
        return False

    def _tell_ready(self) -> None:
        command = "cell send start"
        if self._runs.resolve() != Path("runs").resolve():
            command += f" --runs {self._runs}"
        print(f"idle: waits for start (`{command}`, or Start on the page)", file=sys.stderr)

    def _adapters(self, config: Path) -> Adapters:
        names = () if self._settings.plant is None else self._settings.plant.start
        commands: dict[str, list[str]] = {
            name: command_of(name, config, self._runs) for name in names
        }
        return Adapters(commands, self.reporter.adapter)

    def _report_to(self, link: Link) -> None:
        products = {
            name: {"model": made.task.model, "calibration": made.calibration}
            for name, made in self._made.tasks.items()
        }
        self.reporter = Reporter(link.publish, products)

    def _link(self, handler: Handler, accepted: Collection[MachineEvent]) -> Link:
        status = Status(
            run="",
            sequence=0,
            state=self._cell.machine.state,
            since_s=time.time(),
            product=self._made.products.usual,
            products=self._made.products.names,
            line=line_name(self._settings),
            model=model_hash(self._settings.model),
            calibration=calibration_hash(self._settings),
            software=version("cable-cell"),
        )
        return Link(self._runs, status, handler, accepted)

    def _answer(self, request: Request) -> CommandReply:
        if request.command in LATCHED:
            return latch(self._cell, request)
        command = request.command.value if request.command else "product"
        why = "this run makes a number of cycles; `cell run --cycles forever` takes starts"
        return refusal(self._cell, command, why)


def interrupted(result: Result) -> bool:
    """Whether a cycle was ended by Ctrl-C or a closed terminal, not by a command to the cell."""
    causes = ("interrupted by a person", "the terminal was closed")
    return result.fault is not None and result.fault.cause in causes
