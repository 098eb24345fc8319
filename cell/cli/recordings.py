"""Commands about past cycles and their recordings: list, show, report, replay, recover; and about
the store of recordings: upload, fetch.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cell.cli.arguments import Runs, RunsFolder, folder_of, taking
from cell.cli.output import Json, JsonCommand, deliver, deliver_result, print_json
from cell.cli.output import show as show_parts
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    AsJson,
    Config,
    Force,
    group,
    refusing,
    working,
)
from cell.files.rescue import why_not_written
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.files.table import TableData
    from cell.records.recording.recover import Recovered

app = group()

#: Number of differences that are printed; --json has all.
_MOST_PRINTED = 20


@app.command("list")
def list_cycles(
    runs: RunsFolder = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """List past cycles, the newest last: outcome, offset, forecast error, pictures.

    Exit codes: 0, or 2 if the folder is wrong.
    """
    from cell.cli.cycle_tables import history_table
    from cell.records.folder import history

    with refusing():
        past = history(runs)
    if as_json:
        print_json([p.to_json() for p in past])
    elif past:
        show_parts(history_table(past), f"look at one: cell show {runs}/FOLDER")
    else:
        print(f"{runs}: has no cycles; `cell run --runs {runs}` records some")


@app.command()
def show(
    folder: Annotated[
        Path | None, typer.Argument(help="A cycle's folder; default: the newest.")
    ] = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
    pictures: Annotated[
        bool, typer.Option("--open", help="Open the pictures with the computer's viewer.")
    ] = False,
) -> None:
    """Show a past cycle: how it ended and why, the cable's parameters, times, pictures.

    Exit codes: 0, or 2 if the folder is wrong.
    """
    from cell.cli.cycle_tables import record_parts
    from cell.files.plain import plain
    from cell.records.folder import newest, pictures_in, read_record

    with refusing():
        record = read_record(newest(runs) if folder is None else folder)
    images = pictures_in(record.folder)
    if as_json:
        result = None if record.result is None else record.result.to_json()
        content = {"folder": str(record.folder), "state": plain(record.state), "result": result}
        print_json({**content, "pictures": [str(image) for image in images]})
    else:
        show_parts(*record_parts(record, images))
    if pictures:
        for image in images:
            typer.launch(str(image))


@app.command()
def report(
    ctx: typer.Context,
    folder: Annotated[
        Path | None,
        typer.Argument(help="A cycle's folder or its recording; default: the newest."),
    ] = None,
    runs: Runs = Path("runs"),
    out: Annotated[Path, typer.Option("-o", "--out", help="Write the page to this file.")] = Path(
        "report.html"
    ),
    force: Force = False,
) -> None:
    """Write one HTML page of one cycle: result, film strip, path of the tip, decision, times.

    The page needs no network.  Exit codes: 0; 2 if the folder is wrong.
    """
    from cell.files.page import write_page
    from cell.records.cycle_page import cycle_page
    from cell.records.folder import newest, read_record
    from cell.records.recording import form
    from cell.records.recording.reading import read_recording

    with refusing(out, force=force), working("report") as progress:
        source = newest(runs) if folder is None else folder
        film = source if source.is_file() else source / form.FILE
        record = read_record(folder_of(ctx, source))
        progress("drawing")
        page = cycle_page(record, read_recording(film) if film.exists() else None)
    deliver(lambda: None, (out, partial(write_page, page)))
    print(f"written to {out}")


@dataclass(frozen=True)
class ReplayOptions:
    """Options of `cell replay`."""

    recording: Annotated[
        Path,
        typer.Argument(
            help="A recording (recording.mcap) or a cycle's folder; with --import a video, or a "
            "folder of pictures."
        ),
    ]
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", "-c", help="Other settings than those in the recording, to compare."
        ),
    ] = None
    as_cell: Annotated[
        Path | None,
        typer.Option(
            "--as-cell",
            help="Keep the folder of the replayed cycle in this folder, as `cell run` would.",
        ),
    ] = None
    imported: Annotated[
        bool,
        typer.Option(
            "--import", help="Make a recording of a film of your own: see --poses, --config, --out."
        ),
    ] = False
    poses: Annotated[
        Path | None,
        typer.Option(help="With --import: CSV of the gripper, t_s, x_m, y_m, angle_rad."),
    ] = None
    frame_rate_hz: Annotated[
        float | None,
        typer.Option(
            "--frame-rate",
            min=1.0,
            help="With --import: frames per second; default: as frames.csv or the video says.",
        ),
    ] = None
    first_frame_s: Annotated[
        float,
        typer.Option(
            "--first-frame",
            help="With --import: when the film begins on the clock of the poses, s.",
        ),
    ] = 0.0
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="With --import: recording to write; default: FILM.mcap."),
    ] = None
    force: Force = False
    as_json: Json = None


@app.command(cls=JsonCommand)
@taking(ReplayOptions)
def replay(options: ReplayOptions) -> None:
    """Run a recorded cycle again, on its frames and poses, and compare the decisions.

    Vision, identification, simulation and choice compute everything anew, and the whole cycle is
    carried out on devices that play the recording.  The same software, settings and model give the
    same numbers to the last bit.  With other software or other settings the command prints what
    differs.

    With --import a film of your own becomes a recording: pictures or a video of a cable at rest,
    jerked and swinging, seen as the settings say (camera.view or the calibration), and the poses of
    the gripper.  Its cable is identified.  If the gripper ends where insertions begin, an offset is
    chosen too.

    Exit codes: 0 if everything is the same, or the film was imported; 1 if something differs, or
    the film's cable was rejected; 2 if the recording cannot be replayed or the film not be read.
    """
    if options.imported:
        _import(options)
    from cell.cli.cycle_tables import replayed_parts
    from cell.records.recording.reading import read_recording
    from cell.wiring.replay import replay as replay_cycle

    of_import = (options.poses, options.frame_rate_hz, options.out)
    with (
        refusing(options.as_json, force=options.force),
        working("replay") as progress,
        TemporaryDirectory() as folder,
    ):
        if any(value is not None for value in of_import):
            raise ValueError("--poses, --frame-rate and --out are of --import")
        recorded = read_recording(options.recording)
        replayed = replay_cycle(
            recorded,
            options.config,
            Path(folder) if options.as_cell is None else options.as_cell,
            progress.step,
        )

    def parts() -> Iterator[str | TableData]:
        yield from replayed_parts(replayed, most=_MOST_PRINTED)
        if options.as_cell is not None:
            yield f"replayed in {replayed.result.folder}"

    deliver_result(replayed.to_json(), [options.as_json], parts)
    raise typer.Exit(NOT_ALL_DONE if replayed.differences else ALL_DONE)


def _import(options: ReplayOptions) -> NoReturn:
    from cell.cli.cycle_tables import imported_parts
    from cell.records.result import Outcome
    from cell.settings import load_settings
    from cell.wiring.filmed import read_film, record_film

    film = options.recording
    target = film.with_name(f"{film.name}.mcap") if options.out is None else options.out
    with refusing(target, options.as_json, force=options.force), working("import") as progress:
        if options.poses is None or options.config is None:
            raise ValueError(
                "--import needs --poses and --config: where the gripper was, and how the camera "
                "sees"
            )
        settings = load_settings(options.config)
        read = read_film(film, options.poses, options.frame_rate_hz, options.first_frame_s)
        result = record_film(read, settings, options.config, target, progress.step)
    data = {"recording": str(target), "result": result.to_json()}
    next_line = f"{target}: replay it, or give it to the lab, as `cell diagnose {target}`"
    deliver_result(data, [options.as_json], lambda: (*imported_parts(result), next_line))
    raise typer.Exit(ALL_DONE if result.outcome is Outcome.MEASURED else NOT_ALL_DONE)


@app.command(cls=JsonCommand)
def recover(
    places: Annotated[
        list[Path],
        typer.Argument(help="Torn recordings, or folders in which to look for them."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="File to write; default: recording.mcap next to the torn one."
        ),
    ] = None,
    as_json: Json = None,
) -> None:
    """Repair torn recordings, and print what is missing.

    A recording is torn when the power was cut, the disk was full or a process was killed.  What
    was written is copied to a new file, which is then read back and verified.  The torn file is
    removed only if nothing in it is damaged.  Recordings in folders that are not torn are read
    too: the damaged ones are named, and stay as they are.

    Exit codes: 0 if all were recovered, or none is torn; 1 if one could not be, or is damaged; 2 if
    there is no recording.
    """
    from cell.files.input_error import InputError
    from cell.records.recording.recover import damaged_recordings, recover_in_place, torn_recordings

    done: list[Recovered] = []
    failed: list[str] = []
    with refusing(out, as_json), working("recover") as progress:
        torn = [file for place in places for file in torn_recordings(place)]
        if out is not None and len(torn) != 1:
            raise ValueError(f"--out {out}: {len(torn)} torn recordings were found, not one")
        for file in torn:
            progress(str(file))
            try:
                done.append(recover_in_place(file, out))
            except InputError as error:
                failed.append(str(error))
            except OSError as error:
                failed.append(why_not_written(error))
        failed += [str(error) for place in places for error in damaged_recordings(place)]
    data = {"recovered": [r.to_json() for r in done], "failed": failed}
    for text in failed:
        print(text, file=sys.stderr)
    none = [] if done or failed else ["no torn recording was found"]
    deliver_result(data, [as_json], lambda: (*map(_recovered_text, done), *none))
    raise typer.Exit(NOT_ALL_DONE if failed else ALL_DONE)


def _recovered_text(recovered: Recovered) -> str:
    messages = recovered.messages
    frames, poses = messages.get("/camera/image", 0), messages.get("/arm/measured", 0)
    text = f"{recovered.file}: {counted(frames, 'frame')}, {counted(poses, 'pose')}, verified"
    if recovered.frames_s is not None:
        text += f"; last frame {recovered.frames_s:.3f} s after the beginning"
    if recovered.poses_s is not None:
        text += f", last pose {recovered.poses_s:.3f} s"
    if recovered.damaged_bytes:
        text += f"; {recovered.damaged_bytes} bytes are damaged: {recovered.source} is kept"
    return text


@app.command()
def upload(
    runs: RunsFolder = Path("runs"),
    *,
    config: Config,
) -> None:
    """Bring recordings to the store of the settings (recording.store), verify, remove them here.

    `cell run` uploads between two cables; this command uploads what is left.  A recording whose
    cycle's folder has a file named `keep` stays here too.  Run it while no cable is in the jaws.

    Credentials come from the environment: for s3:// AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and,
    for a server of your own, AWS_ENDPOINT_URL; for other stores see fsspec's documentation.

    Exit codes: 0; 1 if some could not be uploaded, which stay here; 2 if the settings name no
    store.
    """
    from cell.files.input_error import InputError
    from cell.records.recording.store import RecordingStoreError, Store
    from cell.records.recording.uploads import bring, waiting
    from cell.settings import load_settings
    from cell.settings.provenance import line_name

    failed = done = 0
    with refusing():
        settings = load_settings(config)
        if settings.recording is None or settings.recording.store is None:
            raise InputError.at(config, "is missing; name a store", key="recording.store")
        if not runs.is_dir():
            raise InputError.at(runs, "is missing; give the folder of `cell run --runs`")
        pending = waiting(runs)
        try:
            store = Store(settings.recording.store)
        except RecordingStoreError as error:
            raise ValueError(str(error)) from error
        with working("upload") as progress:
            for number, recording in enumerate(pending):
                progress(str(recording), number, len(pending))
                try:
                    done += bring(store, recording, line_name(settings), nullcontext) is not None
                except (RecordingStoreError, OSError) as error:
                    failed += 1
                    print(f"{recording}: {error}", file=sys.stderr)
    print(f"{store.url}: uploaded and verified: {done}; not uploaded: {failed}")
    raise typer.Exit(NOT_ALL_DONE if failed else ALL_DONE)


@app.command()
def fetch(
    folder: Annotated[Path, typer.Argument(help="A cycle's folder.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="File to write; default: recording.mcap in the folder."),
    ] = None,
) -> None:
    """Bring the recording of a cycle back from the store, and verify it.

    Exit codes: 0; 1 if the store cannot deliver it; 2 if the cycle's recording is in no store.
    """
    from cell.files.input_error import InputError
    from cell.records.recording import form
    from cell.records.recording.store import RecordingStoreError, stored_of
    from cell.records.recording.store import fetch as fetch_stored

    target = folder / form.FILE if out is None else out
    with refusing(None if out is None and target.exists() else target):
        if out is None and target.exists():
            raise ValueError(f"{target}: is here already; give another name with -o, or remove it")
        stored = stored_of(folder)
        if stored is None:
            raise InputError.at(folder / form.FILE, "is not in a store")
        try:
            with working("fetch") as progress:
                fetch_stored(stored, target, lambda x: progress(stored.url, int(100 * x), 100))
        except RecordingStoreError as error:
            print(error, file=sys.stderr)
            raise typer.Exit(NOT_ALL_DONE) from error
    print(f"{target}: {stored.bytes / 1e6:.0f} MB, verified")
