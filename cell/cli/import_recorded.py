"""What `cell import` makes of films and of recordings of this program: a study at once."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import typer

from cell.cli.delivery import deliver, json_files
from cell.cli.given import folder_in
from cell.cli.lab import refusing, working
from cell.cli.result_json import print_result
from cell.cli.shared import ALL_DONE, tell_notes
from cell.files.overwriting import check_new_study, check_output
from cell.files.words import counted


@dataclass(frozen=True)
class RecordedImport:
    """Films or recordings, and where their study is to be.

    hand           of a film: CSV of the hand, t_s, x_m, y_m, angle_rad
    config         of a film: settings of the cell that filmed it
    rate_hz        of a film: frames a second; None = as it says
    first_frame_s  of a film: when it begins on the hand's clock
    """

    files: tuple[Path, ...]
    out: Path
    hand: Path | None
    config: Path | None
    rate_hz: float | None
    first_frame_s: float
    force: bool
    as_json: Path | None


def film_study(given: RecordedImport) -> NoReturn:
    """A video of a cable becomes a recording, by the cell's own vision, and that a study."""
    from cell.settings import load_settings
    from cell.wiring.filmed import read_film, record_film

    with refusing(), working("import") as progress:
        if len(given.files) > 1 or given.config is None or given.hand is None:
            raise ValueError(
                "a video needs --config and --hand: how the camera sees, and where the hand was; "
                "give one video at a time"
            )
        check_new_study(given.out, force=given.force)
        film = given.files[0]
        settings = load_settings(given.config)
        read = read_film(film, given.hand, given.rate_hz, given.first_frame_s)
        given.out.mkdir(parents=True, exist_ok=True)
        recording = given.out / f"{film.stem}.mcap"
        check_output(recording, force=given.force)
        record_film(
            read,
            settings,
            given.config,
            recording,
            lambda number, step: progress(step.replace("_", " ")),
        )
    recordings_study(given, [recording])


def recordings_study(given: RecordedImport, recordings: list[Path]) -> NoReturn:
    """Recordings of this program need no mapping."""
    from cell.lab.data.merge_studies import merge_into

    with refusing(), working("import"), ExitStack() as stack:
        check_new_study(given.out, force=given.force)
        folders = [folder_in(stack.enter_context, recording) for recording in recordings]
        study, left_out = merge_into(given.out, folders)
    notes = [*study.notes, *(f"left out: {line}" for line in left_out)]
    trials = [{"name": t.name, "role": t.role, "start": t.start} for t in study.trials]
    data = {"format": "cable-imported/1", "study": str(given.out), "trials": trials, "notes": notes}

    def printed() -> None:
        if print_result(data, given.as_json):
            tell_notes(notes)
            trials_said = counted(len(study.trials), "trial")
            print(f"{given.out}: {trials_said} of {counted(len(recordings), 'recording')}")

    deliver(printed, *json_files(data, given.as_json))
    raise typer.Exit(ALL_DONE)
