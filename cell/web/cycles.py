"""What the pages serve of a cycle's folder: its newest picture and its report."""

from __future__ import annotations

from pathlib import Path

from cell.records.folder import cycle_of


def cycle_folder(runs: Path, name: str) -> Path | None:
    """Folder of a cycle in `runs`; None = the name is no cycle's, or leads elsewhere."""
    folder = runs / name
    if folder.name != name or cycle_of(folder) is None:
        return None
    return folder if folder.resolve().parent == runs.resolve() else None


def newest_picture(folder: Path) -> Path | None:
    """The picture that was written last; None = there is none."""
    found = [p for p in folder.glob("*.png") if p.is_file() and not p.is_symlink()]
    return max(found, key=lambda p: p.stat().st_mtime_ns, default=None)


def picture(folder: Path, name: str) -> Path | None:
    """A picture of a cycle by its file's name; None = there is none of this name."""
    return next((p for p in folder.glob("*.png") if p.name == name and not p.is_symlink()), None)


def report(folder: Path) -> str:
    """The page of `cell report`.  Raises InputError: the folder cannot be read."""
    from cell.records.cycle_page import cycle_page
    from cell.records.folder import read_record
    from cell.records.recording import form
    from cell.records.recording.reading import read_recording

    film = folder / form.FILE
    return cycle_page(read_record(folder), read_recording(film) if film.exists() else None)
