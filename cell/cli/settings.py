"""Commands that move nothing: init, check, doctor, schema, and the documentation: help."""

from __future__ import annotations

import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import Runs
from cell.cli.output import print_json, show
from cell.cli.shared import ALL_DONE, NOT_ALL_DONE, Config, group, refuse, refusing, tell_notes

if TYPE_CHECKING:
    from cell.settings.starting import CellKind

app = group()
_INSTALLED = Path("share", "doc", "cable-cell")
#: Where `make docs-site` and wheels have the manual for browsers.
_SITE = Path(__file__).resolve().parents[1] / "manual"
#: Folders of the documentation, in the order in which they are read.
_PARTS = ("start", "howto", "explain", "reference")


@app.command()
def init(
    out: Annotated[
        Path,
        typer.Option("-o", "--out", help="Write the settings to this file; it must not exist."),
    ] = Path("cell.yaml"),
    real: Annotated[
        bool, typer.Option("--real", help="For a real cell: UR arm, industrial camera, gripper.")
    ] = False,
    emulated: Annotated[
        bool,
        typer.Option("--emulated", help="For the real drivers with emulated devices."),
    ] = False,
    yes: Annotated[
        bool,
        typer.Option(
            "--yes", "-y", help="Ask nothing; write the defaults, to be edited in the file."
        ),
    ] = False,
) -> None:
    """Write a settings file in which every entry is explained, from a few questions.

    Without a terminal nothing is asked, and the defaults are written.  Those of a simulated and of
    an emulated cell (--emulated) run without changes.  Those of a real one (--real) are examples:
    measure and replace them.

    Exit codes: 0, or 2 if the file exists already or an answer is wrong.
    """
    from pydantic import ValidationError

    from cell.files.atomic import write_new
    from cell.files.input_error import InputError
    from cell.settings import Settings, load_settings
    from cell.settings.starting import answered, commented, questions

    if out.exists():
        refuse(ValueError(f"{out}: exists already; give another file with -o, or move it away"))
    if real and emulated:
        refuse(ValueError("--real and --emulated: give one of them"))
    kind: CellKind = "real" if real else "emulated" if emulated else "simulated"
    answers: dict[tuple[str, ...], Any] = {}
    if not yes and _is_interactive():
        for key, words in questions(kind).items():
            answers[key] = _ask(kind, key, words, answers)
    try:
        text = commented(Settings.model_validate(answered(kind, answers)))
    except ValidationError as error:
        places = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        refuse(ValueError("; ".join(places) + "; nothing was written"))
    try:
        write_new(out, text)
        load_settings(out)
    except OSError as error:
        why = error.strerror or error
        refuse(ValueError(f"{out}: cannot be written: {why}; give another place with -o"))
    except InputError as error:
        print(f"{out}: written, but it must be corrected first", file=sys.stderr)
        refuse(error)
    print(f"{out}: written; next: cell check --config {out}")


@app.command()
def doctor(
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Settings of the cell; default: the default settings."),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Time for which stalls are measured.")
    ] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    runs: Runs = Path("runs"),
) -> None:
    """Check whether this computer can run the cell: cores, scheduler, stalls, pictures/s, disk.

    Nothing is connected and nothing moves. Run it under the usual load of the computer.

    Exit codes: 0 if every condition is met; 1 if not; 2 if the settings are wrong.
    """
    from dataclasses import asdict

    from cell.cli.cycle_tables import conditions_table
    from cell.records.recording.retention import recording_room
    from cell.run.computer_check import CameraLoad, check_computer, check_room
    from cell.settings import Settings, load_settings
    from cell.settings.starting import answered
    from cell.settings.translate import picture_size, vision_of

    with refusing():
        settings = (
            Settings.model_validate(answered("simulated", {}))
            if config is None
            else load_settings(config)
        )
    size = picture_size(settings)
    load = CameraLoad(*size, settings.camera.frame_rate_hz, vision_of(settings))
    checks = check_computer(load, seconds, lambda step: print(f"measuring {step}", file=sys.stderr))
    wanted = settings.recording
    room = None if wanted is None else recording_room(runs, wanted, size[0] * size[1])
    checks.append(check_room(room))
    if as_json:
        print_json([asdict(c) for c in checks])
    else:
        failing = [f"{c.name}: {c.remedy}" for c in checks if not c.met]
        show(conditions_table(checks), "\n".join(failing) or "every condition is met")
    raise typer.Exit(ALL_DONE if all(c.met for c in checks) else NOT_ALL_DONE)


@app.command()
def check(config: Config, runs: Runs = Path("runs")) -> None:
    """Validate the settings and the stored calibration, without moving anything.

    Exit codes: 0 if they are right; 2 if not. Every mistake is reported with line and column.
    """
    from cell.cli.ledger import ledger_errors
    from cell.records.ledger.database import check_file
    from cell.records.recording.retention import recording_room
    from cell.settings import load_settings
    from cell.settings.calibrated import calibrated, not_yet_calibrated
    from cell.settings.check import freedoms, oddities
    from cell.settings.loading import products_of
    from cell.settings.starting import unmeasured_notes
    from cell.settings.translate import picture_size

    with refusing():
        settings = load_settings(config)
        each = products_of(settings).values() or [settings]
        notes = [note for one in each for note in not_yet_calibrated(one, config)]
        if settings.ledger is not None:
            with ledger_errors():
                check_file(settings.ledger.url or runs)
    tell_notes([*oddities(settings), *dict.fromkeys(notes), *unmeasured_notes(settings, config)])
    map_std_m: float | None = None
    if settings.camera.kind == "sim" and settings.calibration is None:
        map_std_m = 0.0  # its map is exact
    elif settings.calibration is not None and not notes:
        map_std_m = calibrated(settings, config).map_std_m
    offsets_m = settings.motion.offsets.values_m
    width_px, height_px = picture_size(settings)
    recorded = settings.recording
    room = None if recorded is None else recording_room(runs, recorded, width_px * height_px)
    print(
        f"{config}: right; arm {settings.arm.kind}, camera {settings.camera.kind}, gripper "
        f"{settings.gripper.kind}; {len(offsets_m)} offsets, {offsets_m[0] * 1e3:g} … "
        f"{offsets_m[-1] * 1e3:g} mm"
        + f"; {freedoms(settings, map_std_m)}"
        + (f"; products {', '.join(settings.products)}" if settings.products else "")
        + ("; nothing is recorded" if room is None else f"; room for {room}")
    )


@app.command()
def schema() -> None:
    """Print the JSON schema of the settings, for editors."""
    from cell.settings import Settings

    print_json(Settings.model_json_schema())


def _is_interactive() -> bool:
    """Whether prompts can be answered: standard input is a terminal."""
    return sys.stdin.isatty()


def _ask(
    kind: CellKind, key: tuple[str, ...], words: str, answers: Mapping[tuple[str, ...], Any]
) -> Any:
    """A valid answer: an invalid one is explained, and the prompt repeated."""
    from cell.settings.starting import answer_of, answer_problem, default

    usual = default(kind, key)
    shown = ", ".join(map(str, usual)) if isinstance(usual, list) else str(usual)
    while True:
        text = typer.prompt(words, default=shown, type=str)
        answer = usual if text == shown else answer_of(text, usual)
        wrong = answer_problem(kind, {**answers, key: answer}, key)
        if wrong is None:
            return answer
        print(f"{wrong}; answer again", file=sys.stderr)


@app.command("help")
def help_(
    topic: Annotated[
        str | None, typer.Argument(help="A topic; without one all are listed.", show_default=False)
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser", help="Open the manual in a browser, at the topic.")
    ] = False,
) -> None:
    """Show what the manual says of a topic, or list the topics.

    Exit codes: 0; 2 if there is no such topic, or no manual for a browser.
    """
    from difflib import get_close_matches

    from rich.console import Console
    from rich.markdown import Markdown

    pages = topics()
    if topic is None and browser:
        _open(_SITE / "index.html")
        return
    if topic is None:
        width = max(map(len, pages), default=0)
        for name, path in pages.items():
            print(f"cell help {name:{width}s}  {_title(path)}")
        return
    page = pages.get(topic.lower())
    if page is None:
        near = get_close_matches(topic.lower(), pages, 1)
        meant = f"did you mean {near[0]!r}? " if near else ""
        refuse(ValueError(f"{topic}: no topic; {meant}`cell help` lists them"))
    if browser:
        _open(_SITE / page.relative_to(_folder()).with_suffix(".html"))
        return
    text = page.read_text(encoding="utf-8")
    if not sys.stdout.isatty():
        print(text)
        return
    console = Console()
    with console.pager(styles=True):
        console.print(Markdown(text))


def _open(page: Path) -> None:
    """A page of the manual in the user's browser; its address is printed as well."""
    import webbrowser

    if not page.exists():
        refuse(ValueError(f"{page}: the manual is not built here; `make docs-site` builds it"))
    print(page.as_uri())
    webbrowser.open(page.as_uri())


def topics() -> dict[str, Path]:
    """Pages of the documentation by their names, in the order of reading."""
    folder = _folder()
    pages = (page for part in ("", *_PARTS) for page in sorted((folder / part).glob("*.md")))
    return {page.stem: page for page in pages}


def _folder() -> Path:
    """Folder of the pages: in a clone, or as installed by a wheel."""
    clone = Path(__file__).resolve().parents[2] / "docs"
    return clone if clone.is_dir() else Path(sysconfig.get_path("data")) / _INSTALLED


def _title(page: Path) -> str:
    """The heading of a page."""
    with page.open(encoding="utf-8") as file:
        return file.readline().lstrip("# ").strip()
