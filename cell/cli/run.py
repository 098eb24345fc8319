"""The command that moves a cell: run."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import SCANNED, part_ids, records_folder, taking
from cell.cli.output import show
from cell.cli.shared import (
    ALL_DONE,
    BAD_INPUT,
    NOT_ALL_DONE,
    Config,
    group,
    interrupted_once,
    refuse,
    tell_notes,
)
from cell.cli.streams import OutputClosedError, emit, silence

if TYPE_CHECKING:
    from cell.cli.cell_factory import BuiltCell, PlantEnd, Products
    from cell.cli.progress import RunProgress
    from cell.records.result import Result
    from cell.run.plans import Plan
    from cell.settings.calibrated import Calibrated
    from cell.settings.model import Settings

app = group()

_NEVER_SLOW = (
    "only with --dry-run; a cable that is moved slowly hardly swings, and a cable that does not "
    "swing cannot be identified"
)


DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Make all motions of a cycle with empty jaws, and check arm, camera and gripper.",
    ),
]
RunSeed = Annotated[
    int,
    typer.Option(
        min=0, help="Random seed of simulated cables and noise; the same seed repeats a run."
    ),
]
Records = Annotated[
    Path,
    typer.Option(
        "--runs",
        help="Folder of the records: one folder in it per cycle.",
        callback=records_folder,
    ),
]
PartId = Annotated[
    str | None,
    typer.Option(
        "--part-id",
        help="Id of the cable; of further ones its number counts on: A-09, A-10.  With - an id is "
        "read from standard input before each, as a scanner types it.",
    ),
]
MotionFile = Annotated[
    Path | None,
    typer.Option(help="Only measure, with this motion file (see `cell suggest`); insert nothing."),
]


#: In place of a number of cycles.
FOREVER = "forever"


def _cycle_count(text: str) -> str:
    """A number of cycles, or `FOREVER`."""
    if text != FOREVER and not (text.isdecimal() and int(text) >= 1):
        raise typer.BadParameter(f"{text!r} is neither a whole number >= 1 nor {FOREVER}")
    return text


@dataclass(frozen=True)
class RunOptions:
    """Options of `cell run`."""

    config: Config
    cycles: Annotated[
        str,
        typer.Option(
            callback=_cycle_count,
            metavar="N|forever",
            help="Number of cables; `forever` = one for every start, as a service.",
        ),
    ] = "1"
    seed: RunSeed = 1
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per cycle instead of tables.")
    ] = False
    out: Records = Path("runs")
    motion: MotionFile = None
    part_id: PartId = None
    product: Annotated[
        str | None,
        typer.Option(help="Product, one of the settings' `products`; part ids may name it, too."),
    ] = None
    whole_frames: Annotated[
        bool,
        typer.Option(
            "--whole-frames",
            help="Record whole frames, 450 MB a cycle, not only the band that vision reads.",
        ),
    ] = False
    dry_run: DryRun = False
    speed: Annotated[
        float,
        typer.Option(min=0.01, max=1.0, help="Share of full speed; only with --dry-run."),
    ] = 1.0

    @property
    def forever(self) -> bool:
        """Whether cables come on request, until the end of the service."""
        return self.cycles == FOREVER

    @property
    def count(self) -> int:
        """Number of cables, if there is one."""
        return 1 if self.forever else int(self.cycles)

    @property
    def laid_out(self) -> int | None:
        """Number of simulated cables; None = unlimited."""
        return None if self.forever else 0 if self.dry_run else self.count

    @property
    def dry_run_speed(self) -> float | None:
        """Fraction of full speed of a dry run; None = no dry run."""
        return self.speed if self.dry_run else None


@app.command()
@taking(RunOptions)
def run(options: RunOptions) -> None:
    """Insert cables one after another, or measure them for the model lab, or make a dry run.

    Exit codes: 0 if all cables were inserted or measured, or if the dry run found no error; 1 if a
    cable was rejected or missed, a cycle failed or the dry run found an error; 2 if the settings or
    the motion are wrong, or another program commands the devices, and nothing has moved; 130 if
    Ctrl-C has ended a cycle.

    At a terminal, press h to hold: the motion is finished, then the gripper stays still.  Press u
    to continue.  A hold never clears a stop.  Ctrl-C stops the arm and closes the record.
    """
    from cell.cli.cell_factory import PlantEnd, build_cell, products_in
    from cell.cli.cycle_tables import troubles
    from cell.cli.logs import to_file
    from cell.cli.progress import RunProgress
    from cell.lab.next.motion_file import load_motion
    from cell.run.plans import INSERTING, measuring
    from cell.wiring.arm_version import check_arm_version, remember_dry_run
    from cell.wiring.build import emulators_asked_for
    from cell.wiring.ownership import owned

    _refuse_contradictions(options)
    results: list[Result] = []
    with _refusing_first(results):
        products = products_in(options.config, options.product, options.whole_frames)
        first, settings, known = _start(products, options)
        plan = measuring(load_motion(m, settings)) if (m := options.motion) else INSERTING
        to_file(options.out.with_name(f"{options.out.name}.log"))
        with (
            owned(settings, options.config),
            emulators_asked_for(settings, options.config, options.seed),
            interrupted_once() as interruption,
            ExitStack() as shown,
        ):

            def on_step(number: int, step: str) -> None:
                interruption.raise_again()
                plant.step(number, step)
                if not options.forever:
                    progress.step(number, step)

            check_arm_version(settings, options.config, options.out, options.dry_run_speed)
            made = build_cell(
                products,
                first,
                known,
                options.out,
                seed=options.seed,
                cycles=options.laid_out,
                on_step=on_step,
            )
            cell = made.cell
            plant = PlantEnd(made, options.out, settings)
            try:
                if options.forever:
                    stopped = plant.serve(
                        plan, partial(_print_result, options.as_json), options.config
                    )
                    raise typer.Exit(interruption.code(NOT_ALL_DONE) if stopped else ALL_DONE)
                shown.enter_context(plant.reachable())
                if options.dry_run:
                    plan = cell.rehearsal(plan, options.speed)
                progress = shown.enter_context(RunProgress(options.count, plan.names))
                for result in _results(made, plant, plan, progress, options):
                    results.append(result)
                    if options.as_json:
                        emit(json.dumps(result.to_json(), ensure_ascii=False))
            finally:
                cell.close()
            remember_dry_run(settings, options.out, results)
    if not options.as_json:
        _show(results, plan.names, options, known.notes, simulated=made.twins is not None)
    changed = changes(options.out, results, options.config, products)
    for line in (*troubles(results), *cell.notes(), *changed):
        print(line, file=sys.stderr)
    reached = sum(r.outcome is plan.aim for r in results)
    raise typer.Exit(ALL_DONE if reached == options.count else interruption.code(NOT_ALL_DONE))


@contextmanager
def _refusing_first(results: Sequence[Result]) -> Iterator[None]:
    """Report an error before anything moves, and end the command.

    results  of cycles that have ended
    """
    from cell.files.input_error import InputError
    from cell.plant.wire import LinkError
    from cell.records.folder import RecordError
    from cell.records.result import Outcome

    try:
        yield
    except OutputClosedError as error:
        if not error.by_reader:
            raise
        silence()
        bad = {Outcome.FAILED, Outcome.MISSED, Outcome.REJECTED, Outcome.UNFIT}
        right = results and not any(r.outcome in bad for r in results)
        raise typer.Exit(ALL_DONE if right else NOT_ALL_DONE) from error
    except (InputError, LinkError) as error:
        refuse(error)
    except RecordError as error:  # it cannot even be begun: nothing of this cycle has moved
        remedy = "choose another folder with --runs, or make it writable, with room"
        print(f"{error}; {remedy}", file=sys.stderr)
        raise typer.Exit(NOT_ALL_DONE if results else BAD_INPUT) from error


def _start(products: Products, options: RunOptions) -> tuple[str | None, Settings, Calibrated]:
    """First product, its settings and calibration.  Raises InputError: nothing may move yet."""
    from cell.settings.calibrated import calibrated
    from cell.settings.starting import refuse_examples, unmeasured_notes

    first = _first(products, options)
    settings = products.default if first is None else products.settings[first]
    refuse_examples(settings, options.config, inserts=not options.dry_run)
    tell_notes(unmeasured_notes(settings, options.config))
    known = products.calibrations[first] if first else calibrated(settings, options.config)
    return first, settings, known


def _first(products: Products, options: RunOptions) -> str | None:
    """Product that the cell is built for; None without products.  Ends with 2: not known."""
    if not products.settings:
        return None
    alone = options.motion is not None or options.dry_run
    open_yet = options.forever or options.part_id == SCANNED
    if open_yet and not alone:
        return products.usual or products.names[0]
    try:
        part = None if open_yet else next(part_ids(options.part_id))
        return products.chosen(options.product, part)
    except ValueError as error:
        refuse(error)


def _refuse_contradictions(options: RunOptions) -> None:
    """End with 2 if options do not go together, or an id is invalid."""
    if options.speed != 1.0 and not options.dry_run:
        refuse(ValueError(f"--speed {options.speed:g}: {_NEVER_SLOW}"))
    if options.forever and (options.dry_run or options.part_id is not None):
        refuse(ValueError("--cycles forever: a dry run is one cycle, and ids come with starts"))
    try:
        part_ids(options.part_id)
    except ValueError as error:
        refuse(ValueError(f"--part-id {error}"))


def _results(
    made: BuiltCell, plant: PlantEnd, plan: Plan, progress: RunProgress, options: RunOptions
) -> Iterator[Result]:
    """Results of successive cycles, up to the first that fails; keys hold and continue.

    While ids are typed, no key holds the cell.  A new model in the settings' file is reported
    once.
    """
    from cell.cli.keyboard import KEYS, MAY_HOLD, Keyboard
    from cell.records.result import Outcome

    cell = made.cell

    def on_key(key: str) -> None:
        if key in KEYS:
            event, hint = KEYS[key]
            cell.command(event, f"key {key}")
            progress.hint(hint)

    notice, orders = "", _orders(made.products, progress, options)
    with ExitStack() as listening:
        if options.part_id != SCANNED and listening.enter_context(Keyboard(on_key)).listens:
            progress.hint(MAY_HOLD)
        for number in range(1, options.count + 1):
            part, product = next(orders, (None, None))
            if part is None and options.part_id is not None:
                return
            if product is not None:
                made.change_product(product)
            plant.reporter.cycle(number, part, product)
            result = cell.run_cycle(number, plan, part)
            plant.reporter.result(result)
            if not notice and (notice := another_model(options.config, made.products.default)):
                progress.print_line(notice)
            yield result
            if result.outcome is Outcome.FAILED:
                return


def _orders(
    products: Products, progress: RunProgress, options: RunOptions
) -> Iterator[tuple[str | None, str | None]]:
    """Part and product of successive cycles, as long as the product is known.

    A typed id without a product is refused, and the next one is awaited.
    """
    for part in part_ids(options.part_id):
        try:
            yield part, products.chosen(options.product, part)
        except ValueError as error:
            progress.print_line(f"{error}; no cable is gripped")
            if options.part_id != SCANNED:
                return
    progress.print_line("no more ids are typed: the run ends")


def _print_result(as_json: bool, result: Result) -> None:
    """One cycle of a service, in a line."""
    from cell.cli.cycle_tables import troubles

    if as_json:
        emit(json.dumps(result.to_json(), ensure_ascii=False))
    else:
        emit("\n".join(troubles([result]) or [f"cable {result.cycle} {result.outcome.value}"]))


def _show(
    results: Sequence[Result],
    steps: Sequence[str],
    options: RunOptions,
    notes: Sequence[str],
    *,
    simulated: bool,
) -> None:
    """Print the tables of a run, and where its records are."""
    from cell.cli.cycle_tables import checks_table, results_table, seconds_table

    dry_run = options.dry_run
    tables = [checks_table(r) for r in results] if dry_run else [results_table(results)]
    name = "dry run" if dry_run else "cable"
    folders = (f"{name} {r.cycle}: {r.folder}" for r in results)
    show(*tables, seconds_table(results, steps, simulated=simulated), *notes, *folders)


def changes(out: Path, results: Sequence[Result], config: Path, products: Products) -> list[str]:
    """Sentences on changes in the line's cycles, by product, each with a remedy."""
    if not products.settings:
        return _changes(out, results, config, products.default)
    lines = []
    for name, settings in products.settings.items():
        of_it = [r for r in results if r.product == name]
        lines += [f"{name}: {line}" for line in _changes(out, of_it, config, settings)]
    return lines


def _changes(out: Path, results: Sequence[Result], config: Path, settings: Settings) -> list[str]:
    from cell.records.chart import signals
    from cell.records.ledger.entry import LedgerError
    from cell.records.ledger.ledger import Ledger
    from cell.records.model_errors import mean_error, newest_models, worsenings
    from cell.settings.provenance import line_name

    if not results or results[-1].model is None or settings.ledger is None:
        return []
    try:
        ledger = Ledger(settings.ledger.url or out)
        history = ledger.results(line_name(settings), settings.product)
        ledger.close()
    except LedgerError as error:
        return [f"whether anything has changed cannot be said: {error}"]
    of_model = [r for r in history if r.model == results[-1].model]
    changes_found, common = signals(of_model), mean_error(of_model)
    lines = [*map(str, changes_found), *([] if common is None else [str(common)])]
    unforecast = common is not None or any(not s.of_cables for s in changes_found)
    learn = f"cell learn {out} --config {config}{_of(settings.product)}"
    if unforecast or any(r.model_misses for r in results):
        lines.append(f"to learn what the model lacks: {learn}")
    elif changes_found:
        lines.append(
            "each cable is identified anew, so forecasts follow; to test whether the model lacks "
            f"anything now: {learn}"
        )
    worse = worsenings(history)
    if worse:
        models = newest_models(history)
        assert models is not None, "it is worse than another"
        lines += [*map(str, worse), _demotion_text(config, settings, models)]
    return lines


def another_model(config: Path, settings: Settings) -> str:
    """Message that the model in the settings' file has changed since this run began; or ""."""
    from cell.files.input_error import InputError
    from cell.settings import load_settings

    try:
        now, begun = _models(load_settings(config)), _models(settings)
    except InputError:  # it is being edited: the next reader reports the error
        return ""
    changed = [name for name, model in begun.items() if now.get(name, model) != model]
    if not changed:
        return ""
    name = changed[0]
    of = f" for {name}" if name else ""
    return (
        f"{config} has another model{of} by now, {now[name]}: the cycles of this run still use "
        f"{begun[name]}, with which it was begun; end it and run again to use the new one"
    )


def _models(settings: Settings) -> dict[str, str]:
    """Hash of every product's model, or that without products as of ""."""
    from cell.settings.loading import products_of
    from cell.settings.translate import model_hash

    return {n: model_hash(s.model) for n, s in (products_of(settings) or {"": settings}).items()}


def _of(product: str | None) -> str:
    return "" if product is None else f" --product {product}"


def _demotion_text(config: Path, settings: Settings, models: tuple[str, str]) -> str:
    """Take a promoted model back if the settings say so; a sentence with the result or remedy.

    models  hashes of the worse model and of its predecessor
    """
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.settings.promotion import undo

    if not settings.promotion.withdraw:
        with suppress(InputError):
            now = _models(load_settings(config)).get(settings.product or "", models[0])
            if now != models[0]:
                return f"{config} has the model {now} by now, not {models[0]}"
        of = _of(settings.product)
        return f"to go back to the model before: cell promote --undo --config {config}{of}"
    try:
        entry = undo(config, settings.product, meant=models)
    except InputError as error:
        return f"the model cannot be taken back: {error}"
    return f"withdrawn, as promotion.withdraw says: {config} has again the model of {entry}"
