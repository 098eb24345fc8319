"""Command that makes a study of files of any form: import."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from cell.cli.arguments import folder_in, taking
from cell.cli.output import Json, JsonCommand, deliver_result
from cell.cli.shared import ALL_DONE, NOT_ALL_DONE, group, refusing, tell_notes, working
from cell.files.atomic import write_atomic
from cell.files.overwriting import check_new_study, check_output
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.cli.progress import ProgressLine
    from cell.lab.report.look_page import StudyOverview
    from cell.study.imports.trials import Files
    from cell.study.imports.understand import Understanding

app = group()

#: Suffixes of video files, which the cell's own vision processes.
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v")
PREVIEW = "preview.html"


@dataclass(frozen=True)
class ImportOptions:
    """Options of `cell import`."""

    files: Annotated[
        list[Path],
        typer.Argument(
            help="Files of one cable, each a trial: CSV, TSV or text tables, TRC, C3D, MCAP, "
            "Excel, .ods, SQLite, .mat, JSON, Parquet, Feather, NumPy, HDF5, netCDF; a video; or "
            "the proposed mapping (import.yaml)."
        ),
    ]
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder of the study; default: that of the mapping."),
    ] = None
    hand: Annotated[
        list[Path] | None,
        typer.Option(
            "--hand", help="File of the gripper, if it is not in the markers' file; one per trial."
        ),
    ] = None
    free_length: Annotated[
        float | None,
        typer.Option(
            "--free-length", min=1e-3, help="Cable from the gripping point to its tip, m."
        ),
    ] = None
    line_density: Annotated[
        float | None, typer.Option("--line-density", min=1e-6, help="Mass per length, kg/m.")
    ] = None
    width: Annotated[
        float | None, typer.Option("--width", min=1e-6, help="Width of a flat cable, m.")
    ] = None
    thickness: Annotated[
        float | None, typer.Option("--thickness", min=1e-7, help="Thickness of a flat cable, m.")
    ] = None
    diameter: Annotated[
        float | None, typer.Option("--diameter", min=1e-6, help="Diameter of a round cable, m.")
    ] = None
    rate: Annotated[
        float | None,
        typer.Option("--rate", min=0.1, help="Rows a second, if the file has no time."),
    ] = None
    clamp_angle: Annotated[
        float | None,
        typer.Option(
            "--clamp-angle",
            min=-math.pi,
            max=math.pi,
            help="Constant angle of the gripper, if no column has it, rad; 0 = level, positive = "
            "tip down.",
        ),
    ] = None
    arc_lengths: Annotated[
        str | None,
        typer.Option(
            "--arc-lengths",
            metavar="M,M,…",
            help="Places of the markers along the cable from the gripper on, m, as 0.02,0.05,0.1.",
        ),
    ] = None
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Of a video: settings of the cell that filmed it."),
    ] = None
    first_frame_s: Annotated[
        float,
        typer.Option("--first-frame", help="Of a video: when it begins on the gripper's clock, s."),
    ] = 0.0
    look: Annotated[
        bool, typer.Option("--open", help="Open the preview with the computer's browser.")
    ] = False
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite an earlier mapping, preview or study.")
    ] = False
    as_json: Json = None


@app.command("import", cls=JsonCommand)
@taking(ImportOptions)
def import_(options: ImportOptions) -> None:
    """Make a study of files of any form: the first call proposes a mapping, the second writes it.

    `cell import trial.csv -o my_study` reads the file, says what it understood and what it guesses,
    and writes my_study/import.yaml and my_study/preview.html.  Check both; edit the mapping.  Then
    `cell import my_study/import.yaml` writes the study and verifies it by reading it back.

    A recording of `cell run`, and a video with --config and --hand, become a study at once.

    Exit codes: 0; 1 if something of the proposal must be mended or filled in; 2 if a file or the
    mapping is wrong.
    """
    if _is_mapping(options.files[0]):
        _write(options)
    elif options.files[0].suffix.lower() in _VIDEOS or options.files[0].is_dir():
        _import_film(options)
    else:
        _propose(options)


def _import_film(options: ImportOptions) -> NoReturn:
    """A video of a cable becomes a recording, by the cell's own vision, and that a study."""
    from cell.settings import load_settings
    from cell.wiring.filmed import read_film, record_film

    with refusing(options.as_json, force=options.force), working("import") as progress:
        out = _folder(options)
        film = options.files[0]
        if film.is_dir():
            _check_pictures(film)
        if len(options.files) > 1 or options.config is None or not options.hand:
            raise ValueError(
                "a video needs --config and --hand: how the camera sees, and where the gripper "
                "was; give one video at a time"
            )
        check_new_study(out, force=options.force)
        settings = load_settings(options.config)
        read = read_film(film, options.hand[0], options.rate, options.first_frame_s)
        out.mkdir(parents=True, exist_ok=True)
        recording = out / f"{film.stem}.mcap"
        check_output(recording, force=options.force)
        record_film(read, settings, options.config, recording, progress.step)
    _import_recordings(options, [recording])


def _check_pictures(folder: Path) -> None:
    """Raises ValueError: a folder holds no pictures; the message names its tables."""
    from cell.study.imports.other_kinds import BAG_METADATA, bag_error
    from cell.study.imports.read import KINDS
    from cell.wiring.filmed import holds_pictures

    if not holds_pictures(folder):
        if (metadata := folder / BAG_METADATA).is_file():
            raise bag_error(metadata, "describes")
        suffixes = [file.suffix for file in sorted(folder.iterdir())]
        tables = dict.fromkeys(s for s in suffixes if s.lower() in KINDS)
        files = " ".join(f"{folder}/*{suffix}" for suffix in tables)
        remedy = f"give its files: {files}" if files else "give files of measurements"
        raise ValueError(f"{folder}: is a folder without pictures; {remedy}")


def _import_recordings(options: ImportOptions, recordings: list[Path]) -> NoReturn:
    """Recordings of this program need no mapping."""
    from cell.lab.data.cycles import measured, merge_studies
    from cell.study.folder import write_study

    with refusing(options.as_json, force=options.force), working("import"), ExitStack() as stack:
        out = _folder(options)
        check_new_study(out, force=options.force)
        folders = [folder_in(stack.enter_context, recording) for recording in recordings]
        studies, left_out = measured(folders)
        write_study(study := merge_studies(studies, out.name), out)
    notes = [*study.notes, *(f"left out: {line}" for line in left_out)]
    trials = [{"name": t.name, "role": t.role, "start": t.start} for t in study.trials]
    counts = f"{counted(len(trials), 'trial')} of {counted(len(recordings), 'recording')}"
    _deliver_imported(options, out, trials, notes, [f"{out}: {counts}"])


def _deliver_imported(
    options: ImportOptions,
    out: Path,
    trials: list[dict[str, Any]],
    notes: list[str],
    lines: list[str],
) -> NoReturn:
    """Print what was imported, and end."""

    def parts() -> list[str]:
        tell_notes(notes)
        return lines

    data = {"format": "cable-imported/1", "study": str(out), "trials": trials, "notes": notes}
    deliver_result(data, [options.as_json], parts)
    raise typer.Exit(ALL_DONE)


def _propose(options: ImportOptions) -> NoReturn:
    from cell.files.page import write_page
    from cell.lab.report.look_page import look_page, preview_of
    from cell.records.recording.form import BEGUN
    from cell.study.imports.capture import Sure
    from cell.study.imports.mapping import FILE
    from cell.study.imports.mcap_file import metadata_names
    from cell.study.imports.write import mapping_text

    with refusing(options.as_json, force=options.force), working("import") as progress:
        out = _folder(options)
        mapping_file, preview = out / FILE, out / PREVIEW
        own = [f for f in options.files if f.suffix == ".mcap" and BEGUN in metadata_names(f)]
        if own and len(own) < len(options.files):
            raise ValueError(
                f"{own[0]}: is a recording of `cell run`; import these apart from others"
            )
        if own:
            _import_recordings(options, own)
        check_new_study(out, force=options.force)
        if mapping_file.exists() and not options.force:
            raise ValueError(
                f"{mapping_file}: is there already, perhaps edited; write the study of it with "
                f"`cell import {mapping_file}`, or give --force to propose it anew"
            )
        check_output(preview, force=options.force)
        files, understood = _understood(options, out, progress)
        look = preview_of(files, understood, mapping_file)
        command = f"cell import {mapping_file}"
        text = mapping_text(understood.mapping, understood.findings, command)
    data = {
        "format": "cable-proposal/1",
        "mapping": str(mapping_file),
        "preview": str(preview),
        "findings": [f.to_json() for f in understood.findings],
        "wrong": list(look.wrong),
        "odd": list(look.odd),
        "trials": [f.to_json() for f in look.facts],
        "next": command,
    }
    next_lines = (
        f"{preview}: look at it",
        f"{mapping_file}: check and edit it, then: {command}",
    )
    deliver_result(
        data,
        [options.as_json],
        lambda: (*_proposal_lines(look), *next_lines),
        (mapping_file, lambda path: write_atomic(path, text)),
        (preview, partial(write_page, look_page(look))),
    )
    if options.look:
        typer.launch(str(preview))
    wanted = any(f.sure is Sure.MISSING for f in understood.findings)
    raise typer.Exit(NOT_ALL_DONE if look.wrong or wanted else ALL_DONE)


def _folder(options: ImportOptions) -> Path:
    """Folder of the new study.  Raises ValueError: it is missing."""
    if options.out is None:
        raise ValueError("--out is missing: name the folder of the new study, as -o my_study")
    return options.out


def _understood(
    options: ImportOptions, out: Path, progress: ProgressLine
) -> tuple[list[Files], Understanding]:
    from cell.study.imports.stated import Stated
    from cell.study.imports.trial_files import read_trials
    from cell.study.imports.understand import understand

    progress("reading the files")
    files = read_trials(options.files, options.hand or [], lambda file: _relative(file, out))
    progress("what the data show")
    stated = Stated(
        out.name,
        options.free_length,
        options.line_density,
        options.width,
        options.thickness,
        options.diameter,
        options.rate,
        options.clamp_angle,
        _arc_lengths_m(options.arc_lengths),
    )
    return files, understand(files, stated)


def _arc_lengths_m(text: str | None) -> tuple[float, ...] | None:
    """Values of --arc-lengths.  Raises ValueError: one is no number."""
    if text is None:
        return None
    try:
        return tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError as error:
        message = f"--arc-lengths {text!r} holds no numbers; give metres, as 0.02,0.05,0.1"
        raise ValueError(message) from error


def _is_mapping(file: Path) -> bool:
    """Whether a file is to be read as a mapping, not as measurements."""
    from cell.study.imports.documents import is_yaml_data

    return file.suffix.lower() in (".yaml", ".yml") and not is_yaml_data(file)


def _relative(file: Path, folder: Path) -> str:
    """A file's path relative to the folder of the mapping."""
    return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()


def _proposal_lines(look: StudyOverview) -> list[str]:
    """Interpretation of the data, the most certain first, and what is odd or wrong."""
    groups = dict(list(look.says.items())[::-1]) | {"Odd:": look.odd, "To be mended:": look.wrong}
    return [
        line
        for head, sentences in groups.items()
        if sentences
        for line in (head, *(f"  {s}" for s in sentences))
    ]


def _write(options: ImportOptions) -> NoReturn:
    from cell.study.imports.convert import read_captures, study_of
    from cell.study.imports.mapping import read_mapping
    from cell.study.imports.write import write_imported
    from cell.study.left_out import notes_of_samples

    with refusing(options.as_json, force=options.force), working("import") as progress:
        if len(options.files) > 1 or options.hand:
            raise ValueError("a mapping names its files itself: give it alone")
        mapping = options.files[0]
        folder = mapping.parent if options.out is None else options.out
        check_new_study(folder, force=options.force)
        read = read_mapping(mapping)
        progress("reading the files")
        imported = study_of(read, read_captures(read))
        notes = [*imported.notes, *notes_of_samples(imported.study)]
        progress("writing the study, and reading it back")
        study = write_imported(imported.study, folder)
    trials = [
        {"name": t.name, "role": t.role, "start": t.start, "frames": len(t.markers.t_s)}
        for t in study.trials
    ]
    frames = sum(len(t.markers.t_s) for t in study.trials)
    counts = f"{counted(len(trials), 'trial')}, {counted(frames, 'frame')}"
    lines = [
        f"{folder}: {counts}, verified by reading back",
        f"look at it: cell look {folder}; then: cell diagnose {folder}",
    ]
    _deliver_imported(options, folder, trials, notes, lines)
