"""Text of a file in whichever encoding programs write: UTF-8, UTF-16, GB 18030, Windows-1252."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

from cell.files.input_error import InputError
from cell.files.text_file import read_bytes
from cell.study.table import MAX_BYTES

#: Minimum Chinese characters of GB 2312; fewer may be accented letters of Windows-1252.
_MIN_CHINESE = 4
_HEAD_BYTES = 1 << 15
_CONTROL_BYTES = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")


def text_of(path: Path) -> tuple[str, list[str]]:
    """Text of a file, and a note if it is not Unicode.

    raises  InputError: it is no text, is missing or too large
    """
    content = read_bytes(path, MAX_BYTES)
    for encoding in _encodings(content):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        return text, [_NOTES[encoding].format(path)] if encoding in _NOTES else []
    raise InputError.at(path, "cannot be read: is not UTF-8 text; save it as UTF-8", column=1)


_NOTES = {
    "cp1252": "{}: is no UTF-8 text; it is read as Windows-1252, as Excel writes it",
    "gb18030": "{}: is no UTF-8 text; it is read as GB 18030, as a Chinese Windows writes it",
}


def _encodings(content: bytes) -> Iterator[str]:
    """Yield the encodings that a text may have, the most likely first."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        yield "utf-16"
        return
    yield "utf-8-sig"
    if b"\0" not in content:
        yield from _windows_encodings(content)


def _windows_encodings(content: bytes) -> list[str]:
    """Encodings of a text that is not Unicode, the most likely first."""
    try:
        chinese = [c for c in content.decode("gb2312") if not c.isascii()]
    except UnicodeDecodeError:
        return ["cp1252"]
    return ["gb18030", "cp1252"] if len(chinese) >= _MIN_CHINESE else ["cp1252"]


def head_of(path: Path) -> str:
    """Beginning of a file as text; empty = it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES).decode("utf-8-sig", errors="replace")
    except OSError:  # reading it later reports the error
        return ""


def is_text(path: Path) -> bool:
    """Whether a file holds text, by its bytes."""
    try:
        content = read_bytes(path, MAX_BYTES)
    except InputError:
        return False
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return True
    return bool(content) and not _CONTROL_BYTES.search(content)
