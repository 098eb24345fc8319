"""A table as data: shown as text at a terminal and as HTML on a page, by the same rows."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class TableData:
    """Cells as text.

    numbers  right-aligned columns
    note     a sentence below
    colours  at a terminal, by the text of a cell
    ends     rows after which a line is drawn
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Collection[int] = ()
    note: str = ""
    colours: Mapping[str, str] = field(default_factory=dict)
    ends: Collection[int] = ()
