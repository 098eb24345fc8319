"""Splits text into rows of cells, by its separator and its decimal mark, without what is no row."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, takewhile
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import NOT_SEEN, Decimal, TextForm, is_number, number
from cell.study.imports.units import unit_of

#: Prefixes of a remark.
REMARKS = ("#", "%", "//")
#: Minimum number of rows of a table.
_MIN_ROWS = 3
#: A number with its unit in one cell.
WITH_UNIT = re.compile(r"([-+]?[\d.,]+(?:[eE][-+]?\d+)?)\s*([^\W\d_]+|°)")
#: Time of reception, which a serial monitor writes before a line.
_RECEIVED = re.compile(r"^\[?\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?\]? ?(?:->|>|\t) ?")
#: A name and its value.
_LABELLED = re.compile(
    r"([^\W\d][\w.]*)\s?[:=]\s?([-+]?(?:\d[\d.]*(?:[eE][-+]?\d+)?|nan))(?![^\s,;])"
)
#: Minimum fraction of a text's lines that begin so.
_MIN_RECEIVED = 0.9
#: Minimum ratio of columns to rows of a table whose rows are series.
_MIN_ASPECT = 2


@dataclass(frozen=True)
class Row:
    """A line's number, counted from 1, and its cells."""

    line: int
    cells: tuple[str, ...]

    @property
    def blank(self) -> bool:
        """Whether all cells are empty."""
        return not any(cell.strip() for cell in self.cells)

    def is_data(self, decimal: Decimal) -> bool:
        """Whether it holds a number, and at least as many numbers as words."""
        filled = [c for c in self.cells if c.strip().lower() not in NOT_SEEN]
        values = [c for c in filled if is_number(c, decimal) or unit_behind(c, decimal)]
        return bool(filled) and 2 * len(values) >= len(filled)


def split_line(line: str, separator: str) -> list[str]:
    """Cells of a line; none where it is no CSV."""
    if separator == " ":
        words = re.findall(r'"[^"]*"|\S+', line) if '"' in line else line.split()
        return [cell.strip('"') for cell in words] if '"' in line else words
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return []


def split_lines(path: Path, lines: Sequence[str], separator: str) -> list[Row]:
    """Rows of cells.  Raises InputError: a line is no CSV."""
    if separator == " ":
        return _between_blanks(lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    try:
        return [Row(reader.line_num, tuple(cells)) for cells in reader]
    except csv.Error as error:
        message = f"is no table: {error}; write plain numbers between {separator!r}"
        raise InputError.at(path, message, line=reader.line_num) from error


def _between_blanks(lines: Sequence[str]) -> list[Row]:
    """Rows of cells between blanks; names that hold single blanks are between two or more."""
    rows = [split_line(line, " ") for line in lines]
    most_common = Counter(len(cells) for cells in rows if cells).most_common(1)
    width = most_common[0][0] if most_common else 0
    for i, line in enumerate(lines):
        words = re.split(r"\s{2,}|\t", line.strip()) if len(rows[i]) > width else []
        if len(words) == width:
            rows[i] = words
    return [Row(i, tuple(cells)) for i, cells in enumerate(rows, 1)]


def unit_behind(cell: str, decimal: Decimal) -> str:
    """The unit after a number; empty = there is none."""
    match = WITH_UNIT.fullmatch(cell.strip())
    return unit_of(match[2]) if match and is_number(match[1], decimal) else ""


def without_reception(path: Path, text: str) -> tuple[str, list[str]]:
    """A serial monitor's text without the times of reception before its lines; and a note.

    Times that are the first column between tabs have a name in a line above them.
    """
    lines = text.splitlines()
    filled = [line for line in lines if line.strip()]
    stamps = [(line, m[0]) for line in filled if (m := _RECEIVED.match(line)) is not None]
    if not stamps or len(stamps) < _MIN_RECEIVED * len(filled):
        return text, []
    widths = {line.count("\t") for line in filled if not _RECEIVED.match(line)}
    if stamps[0][1].endswith("\t") and stamps[0][0].count("\t") in widths:
        return text, []
    note = f"{path}: the time at which a line was received stands before it; it is not read"
    return "\n".join(_RECEIVED.sub("", line) for line in lines), [note]


def labelled_rows(path: Path, text: str) -> tuple[list[str], list[Row], list[str]]:
    """Names, rows and a note of lines of names with values; no names where it has other lines.

    source  Arduino, serial plotter: `t_us:3600 tip_x_mm:4.5`, between blanks, commas or tabs
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    each = {i: dict(_LABELLED.findall(line)) for i, line in lines
            if not _LABELLED.sub("", line).strip(" ,;\t")}  # fmt: skip
    if len(each) < max(_MIN_ROWS, _MIN_RECEIVED * len(lines)):
        return [], [], []
    names = list(dict.fromkeys(name for values in each.values() for name in values))
    rows = [Row(i, tuple(values.get(name, "") for name in names)) for i, values in each.items()]
    others = [i for i, _ in lines if i not in each]
    first = others[0] if others else 0
    note = f"{path}:{first}: {len(others)} lines are no names with values; they are not read"
    return names, rows, [note] if others else []


def upright(path: Path, rows: Sequence[Row], decimal: Decimal) -> tuple[list[Row], list[str]]:
    """Transpose a table whose lines are series, each after its name; and a note."""
    filled = [row for row in rows if not row.blank]
    widths = {len(row.cells) for row in filled}
    wide = len(widths) == 1 and max(widths) >= _MIN_ASPECT * len(filled) > _MIN_ASPECT
    named = wide and all(
        row.cells[0].strip() and not is_number(row.cells[0], decimal) for row in filled
    )
    if not named or not all(Row(row.line, row.cells[1:]).is_data(decimal) for row in filled):
        return list(rows), []
    note = f"{path}: its lines are series, each behind its name; they are read as columns"
    columns = zip(*(row.cells for row in filled), strict=True)
    return [Row(filled[0].line, cells) for cells in columns], [note]


def without_repeats(
    path: Path, rows: Sequence[Row], decimal: Decimal
) -> tuple[list[Row], list[str]]:
    """Rows without remarks and repeated header lines within the table; and a note."""
    data = [row.is_data(decimal) for row in rows]
    first = data.index(True) if True in data else len(rows)
    above = {row.cells for row in rows[:first] if not row.blank}
    result: list[Row] = []
    extra: list[int] = []
    for i, row in enumerate(rows):
        within = i > first and not data[i] and not row.blank and not result[-1].blank
        if within and (row.cells in above or row.cells[0].lstrip().startswith(REMARKS)):
            extra.append(row.line)
        else:
            result.append(row)
    if not extra:
        return result, []
    lines = ", ".join(map(str, extra[:5])) + (" …" if len(extra) > 5 else "")
    note = f"{path}:{extra[0]}: names of columns or remarks stand within the table, in line {lines}"
    return result, [f"{note}; they are left out"]


def without_summary(
    path: Path, rows: Sequence[Row], decimal: Decimal
) -> tuple[list[Row], list[str]]:
    """Rows of a table without the text and summaries below its numbers; and a note."""
    last = len(rows)
    while last > 1 and not goes_on(rows[last - 1], rows[0], decimal):
        last -= 1
    if last == len(rows) or last < _MIN_ROWS:
        return list(rows), []
    note = f"{path}:{rows[last].line}: the table ends here, for no row of numbers follows"
    return list(rows[:last]), [f"{note}; the rest is not read"]


def title_of(rows: Sequence[Row], decimal: Decimal) -> str:
    """The last line above a table that is shorter than the table; empty = there is none."""
    width = max(len(row.cells) for row in rows)
    above = takewhile(lambda row: not row.is_data(decimal), rows)
    titles = [" ".join(words) for row in above if 0 < len(words := bare(row)) < width]
    return titles[-1] if titles else ""


def bare(row: Row) -> list[str]:
    """Filled cells of a line, without the prefix of a remark."""
    words = [cell.strip().lstrip("#%").strip() for cell in row.cells]
    return [word for word in words if word]


def without_row_names(
    path: Path, above: Sequence[Row], table: Sequence[Row]
) -> tuple[list[Row], list[str]]:
    """Rows without their row numbers, which have no column name; and a note.

    source  R, `write.table`: "no column name for a column of row names"
    """
    names = next((row.cells for row in reversed(above) if not row.blank), ())
    firsts = [row.cells[0].strip() for row in table]
    one_fewer = len(names) == len(table[0].cells) - 1 > 1 and all(cell.strip() for cell in names)
    integral = one_fewer and all(cell.isdecimal() for cell in firsts)
    rising = integral and all(int(a) < int(b) for a, b in pairwise(firsts))
    if not rising or any(is_number(cell, ".") for cell in names):
        return list(table), []
    note = f"{path}:{table[0].line}: the first cell of each row is its number, and has no name: it"
    return [Row(row.line, row.cells[1:]) for row in table], [f"{note} is not read"]


def is_like(row: Row, other: Row, decimal: Decimal) -> bool:
    """Whether a row has a number, and numbers, words or gaps in the same cells as `other`."""
    both = [(c, d) for c, d in zip(row.cells, other.cells, strict=False)
            if c.strip().lower() not in NOT_SEEN]  # fmt: skip
    numeric = [is_number(c, decimal) for c, _ in both]
    same = all(flag == is_number(d, decimal) for flag, (_, d) in zip(numeric, both, strict=True))
    return any(numeric) and same and len(row.cells) == len(other.cells)


def goes_on(row: Row, first: Row, decimal: Decimal) -> bool:
    """Whether a row holds numbers, and begins with a number if the first row does."""
    index = next((i for i, c in enumerate(first.cells) if c.strip()), 0)
    cell = row.cells[index].strip() if index < len(row.cells) else ""
    word = not is_number(cell, decimal) and not re.search(r"\d", cell) and bool(cell)
    return row.is_data(decimal) and not (word and is_number(first.cells[index], decimal))


def without_comments(
    path: Path, rows: Sequence[Row], decimal: Decimal
) -> tuple[list[Row], list[str]]:
    """Rows without comments after the last column of numbers; and a note."""
    data = [row for row in rows if row.is_data(decimal)]
    most_common = Counter(len(row.cells) for row in data).most_common(1)
    width = most_common[0][0] if most_common else 0
    longer = [row for row in data if len(row.cells) > width]
    if width < 2 or not longer:
        return list(rows), []
    if any(is_number(cell, decimal) for row in longer for cell in row.cells[width:]):
        return list(rows), []
    widest = max(len(row.cells) for row in longer)
    cut = [
        Row(row.line, row.cells[:width]) if width < len(row.cells) <= widest else row
        for row in rows
    ]
    shown = next((c.strip() for row in longer for c in row.cells[width:] if c.strip()), "")
    note = f"{path}:{longer[0].line}: words behind the last number, such as {shown!r}"
    return cut, [f"{note}, are not read"] if shown else []


#: In order of preference; a blank stands for any number of blanks.
SEPARATORS = (",", ";", "\t", "|", " ")
DECIMALS: tuple[Decimal, ...] = (".", ",")
#: Lines from which the form of a text is detected, and how many of these are sampled.
SAMPLE, _SAMPLED = 400, 80
#: Weight of blanks as the separator: another one may yield so much fewer numbers.
_BLANKS = 0.95
#: A form is rejected if it yields less than this share of the numbers of the detected form.
_FORM_SHARE = 0.5


def text_form(text: str) -> TextForm:
    """Separator and decimal mark under which most of a text is numbers in rows of equal width."""
    lines = _sample(text)
    there = [s for s in SEPARATORS if s == " " or any(s in line for line in lines)]
    forms = [TextForm(separator=s, decimal=d) for s in there for d in DECIMALS]
    return max(forms, key=lambda f: _numbers(lines, f) * (_BLANKS if f.separator == " " else 1.0))


def _sample(text: str) -> list[str]:
    """Lines from all over the beginning of a text."""
    lines = text.splitlines()[:SAMPLE]
    return lines[:: max(1, len(lines) // _SAMPLED)]


def _numbers(lines: Sequence[str], form: TextForm) -> int:
    """Number of numeric cells in rows of equal width, minus the non-numeric ones."""
    counts: Counter[int] = Counter()
    for line in lines:
        cells = split_line(line, form.separator)
        if len(cells) < 2:
            continue
        values = [number(c, form.decimal) for c in cells]
        bad = values.count(None)
        good = sum(v is not None and v == v for v in values)
        if good and good >= bad:
            counts[len(cells)] += good - bad
    return max(counts.values(), default=0)


def check_form(path: Path, text: str, form: TextForm) -> None:
    """Raise InputError if another form fits a text much better than the stated one."""
    lines, own = _sample(text), text_form(text)
    if _numbers(lines, form) >= _FORM_SHARE * _numbers(lines, own):
        return
    raise InputError.at(
        path,
        f"is no table between {form.separator!r} with the decimal mark {form.decimal!r}, as the "
        f"mapping says; it seems to be one between {own.separator!r} with {own.decimal!r}: give "
        f"its trial text: {{separator: {own.separator!r}, decimal: {own.decimal!r}}}",
    )
