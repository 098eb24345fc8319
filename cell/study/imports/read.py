"""Reads a file of measurements by the kind that its name says it is."""

from __future__ import annotations

from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.c3d import read_c3d
from cell.study.imports.capture import Capture, TextForm
from cell.study.imports.delimited import read_delimited
from cell.study.imports.mcap_file import read_mcap
from cell.study.imports.trc import read_trc

#: Endings of names of text tables.
TABLES = (".csv", ".tsv", ".txt", ".dat", ".asc")
KINDS = (*TABLES, ".trc", ".c3d", ".mcap")


def read_capture(path: Path, form: TextForm | None = None) -> Capture:
    """Read a table, a TRC, C3D or MCAP file.

    form    of a text table; None = found from the text
    raises  InputError: it cannot be read
    """
    ending = path.suffix.lower()
    if ending in TABLES:
        return read_delimited(path, form)
    if ending == ".trc":
        return read_trc(path)
    if ending == ".c3d":
        return read_c3d(path)
    if ending == ".mcap":
        return read_mcap(path)
    message = f"{ending or 'no ending'} is no kind of file that is read; give {', '.join(KINDS)}"
    raise InputError.at(path, f"{message}, or a video with --config and --hand")
