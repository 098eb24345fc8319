"""Recordings of a folder, each read as the bytes that a worker needs to identify its cable."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from cell.files.input_error import InputError
from cell.identify.individual import IdentifyOptions
from cell.lab.line.identify_again import options_with
from cell.records.recording.reading import read_recording
from cell.records.recording.unpack import unpack
from cell.workers.identity import code_hash

_RECORDING = ".mcap"
#: Digits of a hash that tell a year's recordings apart.
_DIGITS = 16


@dataclass(frozen=True)
class Packed:
    """A recording as it is sent to a worker.

    name     path below the folder of the recordings
    key      hash of all that its result depends on, the program's code included
    files    of its study: path below the cycle's folder, or the study's, and content
    options  of its identification
    then     content of model.json; None = there was no model
    wrong    why it cannot be identified; empty = it can be tried
    """

    name: str
    key: str = ""
    files: tuple[tuple[str, bytes], ...] = ()
    options: IdentifyOptions = IdentifyOptions()  # noqa: RUF009
    then: bytes | None = None
    wrong: str = ""


def recordings_in(folder: Path) -> list[Path]:
    """Folders of cycles with measurements, studies, and recordings apart from their folder.

    In the order of their paths, which is that of time in a folder of cycles.
    raises  InputError: there is none
    """
    found = sorted(_recordings(folder)) if folder.is_dir() else []
    if not found:
        message = "holds no recorded cycle, no recording (.mcap) and no study"
        raise InputError.at(folder, f"{message}; give the folder that `cell run --runs` wrote to")
    return found


def _recordings(folder: Path) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        here = Path(place)
        if "study.yaml" in files or (here / "study" / "study.yaml").exists():
            folders.clear()
            yield here
        else:
            yield from (here / name for name in files if name.endswith(_RECORDING))


def packer(folder: Path, config: Path | None, effects: Sequence[str]) -> Callable[[Path], Packed]:
    """What reads a recording below a folder.

    config, effects   as of `identify_again.read_recorded`; these are read at once
    raises  InputError, ValueError: of these two
    """
    given = options_with(config, effects)
    known: dict[bytes, IdentifyOptions] = {}

    def options_of(cycle: Path) -> IdentifyOptions:
        """Read once for all recordings with the same settings."""
        settings = cycle / "settings.yaml"
        if config is not None or not ((cycle / "state.json").exists() and settings.exists()):
            return given
        text = settings.read_bytes()
        if text not in known:
            known.clear()  # those of a line change seldom
            known[text] = options_with(settings, effects)
        return known[text]

    def pack(recording: Path) -> Packed:
        name = recording.relative_to(folder).as_posix()
        try:
            if recording.suffix != _RECORDING or recording.is_dir():
                return _packed(name, recording, options_of)
            with TemporaryDirectory() as unpacked:
                cycle = unpack(read_recording(recording), Path(unpacked))
                return _packed(name, cycle, options_of)
        except (ValueError, OSError) as error:  # InputError, EffectError among them
            return Packed(name, wrong=str(error))

    return pack


def _packed(name: str, folder: Path, options_of: Callable[[Path], IdentifyOptions]) -> Packed:
    files = [
        (path.relative_to(folder).as_posix(), path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".yaml", ".csv")
        and path.is_file()
        and ((folder / "study.yaml").exists() or (folder / "study") in path.parents)
    ]
    options = options_of(folder)
    model = folder / "model.json"
    then = model.read_bytes() if model.exists() else None
    return Packed(name, _key(files, options, then), tuple(files), options, then)


def _key(files: Sequence[tuple[str, bytes]], options: IdentifyOptions, then: bytes | None) -> str:
    """Hash of what a result depends on."""
    effects = options.kind.effects
    plain = replace(options, kind=replace(options.kind, effects=()))
    own = [(e.name, "" if e.file is None else e.file.sha256) for e in effects]
    digest = hashlib.sha256(f"{code_hash()}\0{plain}\0{own}".encode())
    for path, content in [*files, ("model.json", then or b"")]:
        digest.update(f"{path}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:_DIGITS]
