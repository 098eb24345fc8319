"""Commands about recordings: replay, recover."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cell.cli.arguments import taking
from cell.cli.output import Json, JsonCommand, deliver, json_files, print_result
from cell.cli.shared import ALL_DONE, NOT_ALL_DONE, Force, group, refusing, working
from cell.files.rescue import why_not_written
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.records.recording.recover import Recovered
    from cell.records.result import Result
    from cell.wiring.replay import Replayed

app = group()

#: So many differences are printed; --json has all.
_MOST_PRINTED = 20


@dataclass(frozen=True)
class ReplayOptions:
    """What `cell replay` is told."""

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
    from cell.records.recording.reading import read_recording
    from cell.wiring.replay import replay as replay_cycle

    of_import = (options.poses, options.frame_rate_hz, options.out)
    with refusing(), working("replay") as progress, TemporaryDirectory() as folder:
        if any(given is not None for given in of_import):
            raise ValueError("--poses, --frame-rate and --out are of --import")
        recorded = read_recording(options.recording)
        replayed = replay_cycle(
            recorded,
            options.config,
            Path(folder) if options.as_cell is None else options.as_cell,
            lambda number, step: progress(step.replace("_", " ")),
        )
    data = replayed.to_json()

    def printed() -> None:
        if print_result(data, options.as_json):
            _show_replayed(replayed, kept=options.as_cell is not None)

    deliver(printed, *json_files(data, options.as_json))
    raise typer.Exit(NOT_ALL_DONE if replayed.differences else ALL_DONE)


def _import(options: ReplayOptions) -> NoReturn:
    from cell.records.result import Outcome
    from cell.settings import load_settings
    from cell.wiring.filmed import read_film, record_film

    film = options.recording
    target = film.with_name(f"{film.name}.mcap") if options.out is None else options.out
    with refusing(target, force=options.force), working("import") as progress:
        if options.poses is None or options.config is None:
            raise ValueError(
                "--import needs --poses and --config: where the gripper was, and how the camera "
                "sees"
            )
        settings = load_settings(options.config)
        read = read_film(film, options.poses, options.frame_rate_hz, options.first_frame_s)
        result = record_film(
            read,
            settings,
            options.config,
            target,
            lambda number, step: progress(step.replace("_", " ")),
        )
    data = {"recording": str(target), "result": result.to_json()}

    def printed() -> None:
        if print_result(data, options.as_json):
            _show_imported(result, target)

    deliver(printed, *json_files(data, options.as_json))
    raise typer.Exit(ALL_DONE if result.outcome is Outcome.MEASURED else NOT_ALL_DONE)


def _show_imported(result: Result, target: Path) -> None:
    from rich.console import Console

    from cell.terminal.fitting import show
    from cell.terminal.replayed import imported_parts

    show(Console(), *imported_parts(result))
    print(f"{target}: replay it, or give it to the lab, as `cell diagnose {target}`")


def _show_replayed(replayed: Replayed, *, kept: bool) -> None:
    from rich.console import Console

    from cell.terminal.fitting import show
    from cell.terminal.replayed import replayed_parts

    show(Console(), *replayed_parts(replayed, most=_MOST_PRINTED))
    if kept:
        print(f"replayed in {replayed.result.folder}")


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
    """Make readable recordings of torn ones, and say what is missing.

    A recording is torn when the power was cut, the disk was full or a process was killed.  What
    was written is copied to a new file, which is then read back and verified.  The torn file is
    removed only if nothing in it is damaged.

    Exit codes: 0 if all were recovered, or none is torn; 1 if one could not be; 2 if there is
    nothing of the kind.
    """
    from cell.files.input_error import InputError
    from cell.records.recording.recover import recover_in_place, torn_recordings

    done: list[Recovered] = []
    failed: list[str] = []
    with refusing(out, as_json), working("recover") as progress:
        found = [file for place in places for file in torn_recordings(place)]
        if out is not None and len(found) != 1:
            raise ValueError(f"--out {out}: {len(found)} torn recordings were found, not one")
        for file in found:
            progress(str(file))
            try:
                done.append(recover_in_place(file, out))
            except InputError as error:
                failed.append(str(error))
            except OSError as error:
                failed.append(why_not_written(error))
    data = {"recovered": [r.to_json() for r in done], "failed": failed}

    def printed() -> None:
        if print_result(data, as_json):
            for recovered in done:
                print(_recovered_text(recovered))
            if not done and not failed:
                print("no torn recording was found")

    for text in failed:
        print(text, file=sys.stderr)
    deliver(printed, *json_files(data, as_json))
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
