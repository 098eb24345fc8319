"""Ids of the cables of a run: typed, counted or scanned."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from itertools import repeat

#: Longest id, as the ledger has room for it.
LONGEST = 200


#: Ids are read from standard input, where a scanner types them.
SCANNED = "-"


def part_ids(said: str | None) -> Iterator[str | None]:
    """Ids of one cable after another; None = they have none.

    said    an id whose last digits count on, or `SCANNED`; None = no ids
    raises  ValueError: no id
    """
    if said is None:
        return repeat(None)
    return _scanned() if said == SCANNED else _counted(checked(said))


def checked(part: str) -> str:
    """The id, stripped.  Raises ValueError: it is empty, too long or not printable."""
    part = part.strip()
    if not part or not part.isprintable() or len(part) > LONGEST:
        raise ValueError(f"{part!r} is no id; give 1 to {LONGEST} printable characters")
    return part


def _counted(first: str) -> Iterator[str]:
    found = re.fullmatch(r"(.*?)(\d*)", first)
    assert found is not None
    stem, digits = found[1], found[2]
    yield first
    if not digits:  # the first is followed by a second of its name
        stem, digits = f"{first}-", "1"
    number = int(digits)
    while True:
        number += 1
        yield f"{stem}{number:0{len(digits)}d}"


def _scanned() -> Iterator[str]:
    while line := sys.stdin.readline():
        try:
            part = checked(line)
        except ValueError as error:
            print(f"{error}; scan it again", file=sys.stderr)
            continue
        yield part
