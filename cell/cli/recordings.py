"""Commands about recordings: replay, recover."""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.delivery import deliver, json_files
from cell.cli.lab import refusing, working
from cell.cli.result_json import Json, JsonCommand, print_result
from cell.cli.shared import ALL_DONE, NOT_ALL_DONE, group

if TYPE_CHECKING:
    from cell.records.recording.recover import Recovered
    from cell.replay import Replayed

app = group()

#: So many differences are printed; --json has all.
_MOST_PRINTED = 20


@app.command(cls=JsonCommand)
def replay(
    recording: Annotated[
        Path, typer.Argument(help="A recording (recording.mcap), or a cycle's folder.")
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", "-c", help="Other settings than those in the recording, to compare."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--as-cell",
            help="Keep the folder of the replayed cycle in this folder, as `cell run` would.",
        ),
    ] = None,
    as_json: Json = None,
) -> None:
    """Run a recorded cycle again, on its frames and poses, and compare the decisions.

    Vision, identification, simulation and choice compute everything anew, and the whole cycle is
    carried out on devices that play the recording.  The same software, settings and model give the
    same numbers to the last bit.  With other software or other settings the command prints what
    differs.

    Exit codes: 0 if everything is the same; 1 if something differs; 2 if the recording cannot be
    replayed.
    """
    from cell.records.recording.reading import read_recording
    from cell.replay import replay as replay_cycle

    with refusing(), working("replay") as progress, TemporaryDirectory() as folder:
        recorded = read_recording(recording)
        replayed = replay_cycle(
            recorded,
            config,
            Path(folder) if out is None else out,
            lambda number, step: progress(step.replace("_", " ")),
        )
    data = replayed.to_json()

    def printed() -> None:
        if print_result(data, as_json):
            _show_replayed(replayed, kept=out is not None)

    deliver(printed, *json_files(data, as_json))
    raise typer.Exit(NOT_ALL_DONE if replayed.differences else ALL_DONE)


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
            "-o", "--out", help="File to write; default: recording.mcap beside the torn one."
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
            except (InputError, OSError) as error:
                failed.append(str(error))
    data = {"recovered": [r.to_json() for r in done], "failed": failed}

    def printed() -> None:
        if print_result(data, as_json):
            for recovered in done:
                print(_told(recovered))
            if not done and not failed:
                print("no torn recording was found")

    for text in failed:
        print(text, file=sys.stderr)
    deliver(printed, *json_files(data, as_json))
    raise typer.Exit(NOT_ALL_DONE if failed else ALL_DONE)


def _told(recovered: Recovered) -> str:
    messages = recovered.messages
    frames, poses = messages.get("/camera/image", 0), messages.get("/arm/measured", 0)
    text = f"{recovered.file}: {frames} frames, {poses} poses, verified"
    if recovered.frames_s is not None:
        text += f"; last frame {recovered.frames_s:.3f} s after the beginning"
    if recovered.poses_s is not None:
        text += f", last pose {recovered.poses_s:.3f} s"
    if recovered.damaged_bytes:
        text += f"; {recovered.damaged_bytes} bytes are damaged: {recovered.source} is kept"
    return text
