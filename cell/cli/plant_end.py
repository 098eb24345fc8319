"""Connects `cell run` to the plant: its link, and the service of `--cycles forever`."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cell.cli.cell_factory import BuiltCell
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

_LOG = logging.getLogger(__name__)


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
        """A run of so many cycles: it can be looked at and held, and takes no starts.

        Where there can be no socket, or another cell has it, the run goes on without.
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

    def serve(self, plan: Plan, told: Callable[[Result], None], config: Path) -> bool:
        """Make cycles on request until SIGTERM; whether Ctrl-C stopped one that was under way.

        config  the settings' file, for the adapters that it lets start
        raises  LinkError: another cell runs there already; InputError; RecordError
        """
        link = self._link(lambda request: service.answer(request), COMMANDS)
        stopped = False

        def tell(result: Result) -> None:
            nonlocal stopped
            told(result)
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
        with closing(self._adapters(config)) as adapters, link, _ended_by_sigterm(service):
            adapters.start()
            try:
                service.run(tell)
            except KeyboardInterrupt:
                return stopped
        return False

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

    def _link(self, handler: Handler, obeyed: Collection[MachineEvent]) -> Link:
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
        return Link(self._runs, status, handler, obeyed)

    def _answer(self, request: Request) -> CommandReply:
        if request.command in LATCHED:
            return latch(self._cell, request)
        what = request.command.value if request.command else "product"
        why = "this run makes a number of cycles; `cell run --cycles forever` takes starts"
        return refusal(self._cell, what, why)


def interrupted(result: Result) -> bool:
    """Whether a cycle was ended by Ctrl-C or a closed terminal, not by a command to the cell."""
    causes = ("interrupted by a person", "the terminal was closed")
    return result.fault is not None and result.fault.cause in causes


@contextmanager
def _ended_by_sigterm(service: Service) -> Iterator[None]:
    """SIGTERM ends the service after the cycle under way."""

    def end(number: int, frame: Any) -> None:
        service.end()

    former = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)
