"""Commands about the store of recordings: upload, fetch."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.shared import ALL_DONE, NOT_ALL_DONE, Config, group, refusing, working

app = group()


@app.command()
def upload(
    runs: Annotated[
        Path, typer.Argument(help="Folder of the cycles: that of `cell run --runs`.")
    ] = Path("runs"),
    *,
    config: Config,
) -> None:
    """Bring recordings to the store of the settings (recording.store), verify, remove them here.

    `cell run` does so between two cables; this does what it had no time for.  A recording whose
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
        found = waiting(runs)
        try:
            store = Store(settings.recording.store)
        except RecordingStoreError as error:
            raise ValueError(str(error)) from error
        with working("upload") as progress:
            for number, recording in enumerate(found):
                progress(str(recording), number, len(found))
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

    Exit codes: 0; 1 if the store does not give it; 2 if the cycle's recording is in no store.
    """
    from cell.files.input_error import InputError
    from cell.records.recording import form
    from cell.records.recording.store import fetch as fetch_stored
    from cell.records.recording.store import stored_of

    target = folder / form.FILE if out is None else out
    with refusing(None if out is None and target.exists() else target):
        if out is None and target.exists():
            raise ValueError(f"{target}: is here already; give another name with -o, or remove it")
        stored = stored_of(folder)
        if stored is None:
            raise InputError.at(folder / form.FILE, "is not in a store")
        with _store_errors(), working("fetch") as progress:
            fetch_stored(stored, target, lambda share: progress(stored.url, int(100 * share), 100))
    print(f"{target}: {stored.bytes / 1e6:.0f} MB, verified")


@contextmanager
def _store_errors() -> Iterator[None]:
    from cell.records.recording.store import RecordingStoreError

    try:
        yield
    except RecordingStoreError as error:
        print(error, file=sys.stderr)
        raise typer.Exit(NOT_ALL_DONE) from error
