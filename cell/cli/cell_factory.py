"""Builds the cell of a run from settings and options, and changes it between products."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from cell.files.input_error import InputError

if TYPE_CHECKING:
    from cell.run.cycle import Cell
    from cell.run.station import ProductTask
    from cell.settings.calibrated import Calibrated
    from cell.settings.model import Settings
    from cell.wiring.twins import Twins


@dataclass(frozen=True, eq=False)
class Products:
    """All products that a cell can make, by name in the order of the file; may be empty.

    default       settings of the file
    settings      of each product
    calibrations  of each product
    usual         product that is made unless another is named; None = one must be named
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

    def chosen(self, asked: str | None, part: str | None) -> str | None:
        """What is made of a part, as `product_for` says; None without products."""
        from cell.settings.product import product_for

        return product_for(self.patterns, asked, part, self.usual)


def _with_whole_frames(settings: Settings, config: Path) -> Settings:
    if settings.recording is None:
        message = "says `recording: null`: nothing is recorded; leave out --whole-frames"
        raise InputError.at(config, message)
    recording = settings.recording.model_copy(update={"whole_frames": True})
    return settings.model_copy(update={"recording": recording})


def products_in(config: Path, asked: str | None, whole_frames: bool = False) -> Products:
    """The products of a settings file, with their calibrations.

    asked         the usual one, in place of the file's
    whole_frames  record frames whole
    raises        InputError: settings or calibrations are wrong, or there is no such product;
                  whole frames are wanted where nothing is recorded
    """
    from cell.settings import load_settings
    from cell.settings.calibrated import calibrated
    from cell.settings.loading import load_product, products_of

    whole = load_settings(config)
    if whole_frames:
        whole = _with_whole_frames(whole, config)
    if asked is not None:
        load_product(config, asked)
    settings = products_of(whole)
    known = {name: calibrated(of, config) for name, of in settings.items()}
    usual = asked or (whole.product if settings else None)
    return Products(whole, settings, known, usual)


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
    cycles  number of simulated cables; None = there is always another
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
