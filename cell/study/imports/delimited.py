"""Text tables of unknown form: header, units and rows, wide or long, one or several."""

from __future__ import annotations

import re
import reprlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.files.input_error import InputError
from cell.study.imports.capture import (
    NOT_SEEN,
    Capture,
    CapturedColumn,
    Decimal,
    TextForm,
    is_clock,
    is_day_time,
    is_grouped,
    is_number,
    number,
)
from cell.study.imports.channels import by_channels
from cell.study.imports.contents import contents
from cell.study.imports.header import Header, read_header, repeated, with_legend, without_properties
from cell.study.imports.long_tables import (
    joined,
    of_frames,
    on_one_clock,
    pivoted,
    point_by_point,
    same_frames,
    stacked,
    trials_of_blocks,
)
from cell.study.imports.remarks import stated_time, without_units
from cell.study.imports.repairs import over_midnight, with_dates, with_fine_times
from cell.study.imports.text_content import text_of
from cell.study.imports.text_rows import (
    SAMPLE,
    Row,
    bare,
    check_form,
    goes_on,
    is_like,
    labelled_rows,
    split_lines,
    text_form,
    title_of,
    upright,
    without_comments,
    without_reception,
    without_repeats,
    without_row_names,
)
from cell.study.imports.vector_cells import with_single_cells
from cell.study.table import MAX_ROWS

#: Lines read cell by cell before the others are read at once: more than any header has.
_HEAD = 60
#: Minimum number of cells of a word that means a missing value.
_FEWEST_MISSING = 2
#: Minimum number of blocks, or files, of a frame each.
MIN_FRAMES = 10
#: Maximum number of header lines; those of motion capture have a dozen.
_MAX_HEADER = 200


def read_delimited(path: Path, form: TextForm | None = None) -> Capture:
    """Read a table, wide (a row per time) or long (a row per time and marker).

    Of several tables in one file, separated by blank lines, the one with the most points is
    read, unless they can be joined.

    form    separator and decimal mark; None = detected from the text
    raises  InputError: it holds no table of numbers, or a line is wrong, with line and remedy
    """
    text, notes = _text(path)
    capture = read_text(path, text, form)
    return replace(capture, notes=(*notes, *capture.notes))


def read_text(path: Path, text: str, form: TextForm | None) -> Capture:
    """Read the table of a text.  Raises InputError, as `read_delimited`."""
    if text.count("\n") > MAX_ROWS + _MAX_HEADER:
        message = f"has {text.count(chr(10))} lines, limit {MAX_ROWS}; cut it to the motion"
        raise InputError.at(path, message, line=MAX_ROWS)
    if form is None and (capture := by_channels(path, text.splitlines())) is not None:
        return capture
    names, rows, row_notes = labelled_rows(path, text)
    if form is None and names:
        header = Header(tuple(CapturedColumn(name) for name in names), None, "")
        return pivoted(*captured(path, header, rows, ".")).noted(*row_notes)
    raw = with_single_cells(text.splitlines())
    text = "\n".join(raw)
    if form is not None:
        check_form(path, text, form)
    form = form or text_form(text)
    lines = with_legend(without_properties(raw, form.separator), form.separator)
    if (capture := _long_table(path, lines, form)) is not None:
        return capture
    rows, row_notes = upright(path, split_lines(path, lines, form.separator), form.decimal)
    capture = _main_table(path, _tables(rows, form), form)
    return replace(capture, notes=(*row_notes, *capture.notes))


def read_frames(
    paths: Sequence[Path], numbers: Sequence[int], form: TextForm | None = None
) -> Capture:
    """Read tables of one frame each, with a row per point.

    numbers  of the frames
    raises   InputError: as `read_delimited`, or a table has other columns than the first
    """
    parts = []
    for path, number_of in zip(paths, numbers, strict=True):
        text, _ = _text(path)
        form = form or text_form(text)
        table, labels = _raw_table(path, split_lines(path, text.splitlines(), form.separator), form)
        lines = np.full(len(table.lines), number_of)
        parts.append((replace(table, lines=lines, counted="frame's file"), labels))
    return of_frames(parts, numbers)


def _long_table(path: Path, lines: Sequence[str], form: TextForm) -> Capture | None:
    """The table of a long text with only plain numbers below its head; None = another form."""
    below = _plain_numbers(lines[_HEAD:], form)
    if below is None:
        return None
    tables = _tables(split_lines(path, lines[:_HEAD], form.separator), form)
    if len(tables) > 1:
        return None
    try:
        return pivoted(*_raw_table(path, tables[0], form, below))
    except InputError:
        return None


def _plain_numbers(lines: Sequence[str], form: TextForm) -> np.ndarray | None:
    """(lines, cells) of lines with equally many plain numbers; None = other lines."""
    separator, text = form.separator, "\n".join(lines)
    marks = f"{form.decimal}{separator}".replace(" ", " \t")
    if not re.fullmatch(rf"[0-9eE+\-{re.escape(marks)}\n]+", text):
        return None
    text = text.replace(",", ".") if form.decimal == "," else text
    if separator != " ":
        mark = re.escape(separator)
        text = re.sub(rf"(?:^|(?<={mark}))(?={mark}|$)", "nan", text, flags=re.MULTILINE)
    try:
        delimiter = None if separator == " " else separator
        values = np.loadtxt(text.splitlines(), delimiter=delimiter, ndmin=2)
    except ValueError:  # something is no number, or a line has more or fewer cells
        return None
    return None if len(values) != len(lines) or np.isinf(values).any() else values


def _text(path: Path) -> tuple[str, list[str]]:
    """Text of a file without times of reception, and notes on how it is read.

    raises  InputError: it is no text, is missing or too large
    """
    text, notes = text_of(path)
    text, received = without_reception(path, text)
    return text, [*notes, *received]


def _tables(rows: Sequence[Row], form: TextForm) -> list[Sequence[Row]]:
    """Rows of each table with the lines above it.

    A new one begins where, after a blank line, lines of words come before the next numbers.
    """
    tables: list[Sequence[Row]] = []
    begin, with_numbers, blank, words = 0, False, False, 0
    of_frames_only = sum(stated_time(row.cells) is not None for row in rows) >= MIN_FRAMES
    for i, row in enumerate(rows):
        if row.blank:
            blank, words = True, i + 1
        elif of_frames_only and not blank and stated_time(row.cells):
            blank, words = True, i
        elif not row.is_data(form.decimal) or _is_remark(row, form.decimal):
            words = words if blank else i
        elif not blank or words == i:
            with_numbers, blank = True, False
        elif with_numbers:
            tables.append(rows[begin:words])
            begin, blank = words, False
        else:
            with_numbers, blank = True, False
    return [*tables, rows[begin:]]


def _is_remark(row: Row, decimal: Decimal) -> bool:
    """Whether a row is a remark: a single cell, or a word and its value."""
    filled = [c for c in row.cells if c.strip()]
    return len(row.cells) < 2 or (len(filled) == 2 and not is_number(filled[0], decimal))


def _main_table(path: Path, tables: Sequence[Sequence[Row]], form: TextForm) -> Capture:
    """The table with the most points; columns of others with the same frames are joined to it.

    raises  InputError: the first problem, if no table can be read
    """
    parts: list[tuple[Capture, dict[str, list[str]]]] = []
    read: list[Capture] = []
    problems: list[InputError] = []
    titles = dict[int, str]()
    for rows in _with_names_of_first(path, tables, form):
        try:
            parts.append(_raw_table(path, rows, form))
            titles[int(parts[-1][0].lines[0])] = title_of(rows, form.decimal)
        except InputError as error:
            problems.append(error)
    if len(parts) >= MIN_FRAMES and all(table.stated_time for table, _ in parts):
        return of_frames(parts, range(len(parts)))
    for part, labels in stacked(parts):
        try:
            read.append(pivoted(part, labels))
        except InputError as error:
            problems.append(error)
    if not read:
        raise problems[0]
    if (made := trials_of_blocks(read, titles) or point_by_point(read, titles)) is not None:
        return made
    best = max(read, key=lambda table: len(contents(table).points))
    for other in read:
        if other is best:
            continue
        if same_frames(best, other):
            best = joined(best, other)
        elif (merged := on_one_clock(best, other)) is not None:
            best = merged
        else:
            note = f"{path}:{other.lines[0]}: another table begins here; it is not read"
            best = best.noted(note)
    return best


def _with_names_of_first(
    path: Path, tables: Sequence[Sequence[Row]], form: TextForm
) -> Sequence[Sequence[Row]]:
    """Tables of a point or a frame each, with the lines of names that only the first has.

    As Kinovea writes trajectories: `#T X Y`, then `# tip` above the rows of each point.
    """
    try:
        firsts = [_table_range(path, rows, form)[0] for rows in tables]
    except InputError:
        return tables
    above = [[bare(row) for row in rows[:first] if not row.blank]
             for rows, first in zip(tables, firsts, strict=True)]  # fmt: skip
    if all(lines and stated_time(lines[-1]) for lines in above):
        return [tables[0], *([*tables[0][: firsts[0]], *rows] for rows in tables[1:])]
    below = [rows[first:] for rows, first in zip(tables, firsts, strict=True)]
    widths = {len(rows[0].cells) for rows in below}
    names = next((cells for cells in above[0][:-1] if widths == {len(cells)}), None)
    if names is None or len(tables) < 2 or any(len(lines) != 1 for lines in above[1:]):
        return tables
    return [
        [Row(rows[0].line - 2, (" ".join(lines[-1]),)), Row(rows[0].line - 1, tuple(names)), *rows]
        for lines, rows in zip(above, below, strict=True)
    ]


def _raw_table(
    path: Path, rows: Sequence[Row], form: TextForm, below: np.ndarray | None = None
) -> tuple[Capture, dict[str, list[str]]]:
    """One table with the lines above it, and its columns of words.  Raises InputError.

    below  numbers of the lines that follow; None = there are none.  It is an error if they do not
           go on with the table
    """
    rows, row_notes = without_repeats(path, rows, form.decimal)
    rows, comment_notes = without_comments(path, rows, form.decimal)
    first, last = _table_range(path, rows, form)
    table = _without_empty_end(rows[:first], rows[first:last])
    if form.separator != ",":  # where it may be a decimal mark
        table, numbered = without_row_names(path, rows[:first], table)
        row_notes += numbered
    header = read_header(path, [(r.line, r.cells) for r in rows[:first]], table[0].cells)
    capture, labels = captured(path, header, table, form.decimal)
    if below is not None:
        if last < len(rows) or labels or len(capture.columns) != below.shape[1]:
            raise InputError.at(path, "another table begins; read it apart", line=rows[-1].line)
        lines = np.append(capture.lines, capture.lines[-1] + 1 + np.arange(len(below)))
        capture = replace(capture, values=np.vstack([capture.values, below]), lines=lines)
    rest = [row.line for row in rows[last:] if not row.blank]
    begins = "another table begins here; it is not read"
    if not any(goes_on(row, table[0], form.decimal) for row in rows[last:]):
        begins = "the table ends here, for no row of numbers follows; the rest is not read"
    notes = [f"{path}:{rest[0]}: {begins}"] if rest else []
    return replace(capture, form=form).noted(*row_notes, *comment_notes, *notes), labels


def captured(
    path: Path, header: Header, table: Sequence[Row], decimal: Decimal
) -> tuple[Capture, dict[str, list[str]]]:
    """Columns of numbers, and columns of words by name.

    raises  InputError: a cell of a numeric column is not a number
    """
    table, columns = without_units(path, table, header.columns, decimal)
    table, columns = with_dates(table, columns)
    header = replace(header, columns=columns)
    grouped = any(is_grouped(c.strip(), decimal) for row in table[:SAMPLE] for c in row.cells)
    numeric = _numeric_columns(table, decimal, grouped)
    values, notes = _values(path, table, header, numeric, decimal, grouped)
    first_of_name = _first_of_name(path, header, numeric, values, table[0].line)
    labels = {
        column.name: [row.cells[c].strip() for row in table]
        for c, column in enumerate(header.columns)
        if not numeric[c]
    }
    columns = tuple(
        replace(column, unit="s") if not column.unit and is_clock(table[0].cells[c]) else column
        for c, column in enumerate(header.columns)
        if numeric[c]
    )
    times = [c for c, is_one in enumerate(numeric) if is_one]
    for k, c in enumerate(times):
        if all(is_day_time(row.cells[c]) for row in table):
            values[:, k] = over_midnight(values[:, k])
    lines = np.array([row.line for row in table], dtype=np.intp)
    capture = Capture(path, columns, values, lines, header.rate_hz, header.unit, notes=tuple(notes))
    capture = capture.of_columns(first_of_name)
    capture = replace(capture, pixel_m=header.pixel_m, stated_time=header.time, order=header.order)
    clocks = [header.columns[c].name for c in times if is_clock(table[0].cells[c])]
    return with_fine_times(capture, clocks), labels


def _first_of_name(
    path: Path, header: Header, numeric: Sequence[bool], values: np.ndarray, line: int
) -> list[int]:
    """Indices of the numeric columns without repeated times, which some programs write beside each
    point.

    values  (rows, numeric columns); times missing in the first of them are filled in
    raises  InputError: repeated times differ
    """
    names = [c.name for c, is_numeric in zip(header.columns, numeric, strict=True) if is_numeric]
    firsts = [names.index(name) for name in names]
    for k, first in enumerate(firsts):
        missing = np.isnan(values[:, first])
        values[missing, first] = values[missing, k]
        if np.any(np.abs(values[:, k] - values[:, first]) > 0.0):
            raise repeated(path, names[k], [c.name for c in header.columns], line)
    return sorted(set(firsts))


def _table_range(path: Path, rows: Sequence[Row], form: TextForm) -> tuple[int, int]:
    """First row of the table, and the row after its last.

    raises  InputError: there is none, or a line within it is no row of numbers
    """
    data = [len(r.cells) >= 2 and r.is_data(form.decimal) for r in rows]
    for i in range(1, len(rows)):  # also rows of words whose numbers are all missing
        data[i] = data[i] or (data[i - 1] and is_like(rows[i], rows[i - 1], form.decimal))
    widths = Counter(len(r.cells) for r, is_one in zip(rows, data, strict=True) if is_one)
    if not widths:
        raise InputError.at(
            path, "holds no rows of numbers; give a table with a line of names and numbers below it"
        )
    width = widths.most_common(1)[0][0]
    for i in range(1, len(rows) - 1):
        around = (rows[i - 1], rows[i + 1])
        within = data[i - 1] and data[i + 1] and all(len(r.cells) == width for r in around)
        before = any(data[j] and len(rows[j].cells) == width for j in range(i - 1))
        below_ids = _are_names(rows[i].cells) and not before
        if within and not data[i] and not rows[i].blank and not below_ids:
            raise _row_error(path, rows[i])
    first = _first_row(rows, [i for i, r in enumerate(rows) if data[i] and len(r.cells) == width])
    last, blank = first, False
    for i in range(first, len(rows)):
        if rows[i].blank:
            blank = True
        elif data[i] and (len(rows[i].cells) == width or not blank):
            last = i + 1
        elif blank or not any(data[i:]):
            break
        else:
            raise _row_error(path, rows[i])
    labels = Counter(row.cells[:1] for row in rows[first:last])
    while last > first + 1 and (
        not goes_on(rows[last - 1], rows[first], form.decimal)
        or (_is_remark(rows[last - 1], form.decimal) and labels[rows[last - 1].cells[:1]] == 1)
    ):
        last -= 1
    return first, _check_width(path, rows, first, last, form)


def _first_row(rows: Sequence[Row], of_width: Sequence[int]) -> int:
    """Index of the table's first row among those of numbers.

    A line with a single number belongs to the header, however many separators follow it; so does a
    line of numbers, such as IDs, above a line of words.
    """
    for i in of_width:
        above_names = i + 1 < len(rows) and _are_names(rows[i + 1].cells)
        if not above_names and sum(bool(c.strip()) for c in rows[i].cells) > 1:
            return i
    return of_width[0]


def _are_names(cells: Sequence[str]) -> bool:
    """Whether the cells hold several words and no number."""
    words = [c for c in cells if c.strip().lower() not in NOT_SEEN]
    return len(words) > 1 and not any(c.strip()[0] in "+-.,0123456789" for c in words)


def _check_width(path: Path, rows: Sequence[Row], first: int, last: int, form: TextForm) -> int:
    """`last`.  Raises InputError: a row has another number of cells than the first one."""
    width = len(rows[first].cells)
    for row in rows[first:last]:
        if row.blank:
            message = "is empty within the table; remove the line"
            raise InputError.at(path, message, line=row.line)
        if len(row.cells) != width:
            raise InputError.at(
                path,
                f"has {len(row.cells)} cells between {form.separator!r}, the rows before {width}; "
                "give one for each column, and no separator within a number",
                line=row.line,
            )
    return last


def _row_error(path: Path, row: Row) -> InputError:
    shown = reprlib.repr(" ".join(row.cells).strip())
    message = f"{shown} is no row of numbers like those around it; mend it or remove the line"
    return InputError.at(path, message, line=row.line)


def _without_empty_end(above: Sequence[Row], table: Sequence[Row]) -> list[Row]:
    """Rows without the empty cell that a separator at their ends makes, where it has no name."""
    width = len(table[0].cells)
    named = any(len(row.cells) >= width for row in above)
    if named or width <= 2 or any(row.cells[-1].strip() for row in table):
        return list(table)
    return [Row(row.line, row.cells[:-1]) for row in table]


def _numeric_columns(table: Sequence[Row], decimal: Decimal, grouped: bool) -> list[bool]:
    """Whether the cells of a column are numbers: at least half of those that are filled."""
    numeric = []
    for cells in zip(*(row.cells for row in table), strict=True):
        filled = [c for c in cells if c.strip().lower() not in NOT_SEEN]
        good = sum(number(c, decimal, grouped) is not None for c in filled)
        numeric.append(2 * good >= len(filled))
    return numeric


def _values(
    path: Path,
    table: Sequence[Row],
    header: Header,
    numeric: Sequence[bool],
    decimal: Decimal,
    grouped: bool,
) -> tuple[np.ndarray, list[str]]:
    """(rows, numeric columns), and notes on words that mean a missing value.

    raises  InputError: a cell is no number
    """
    chosen = [c for c, is_numeric in enumerate(numeric) if is_numeric]
    values = np.empty((len(table), len(chosen)))
    words: dict[str, list[tuple[Row, int]]] = {}
    for i, row in enumerate(table):
        for k, c in enumerate(chosen):
            value = number(row.cells[c], decimal, grouped)
            if value is None and re.search(r"\d", row.cells[c]):
                raise _number_error(path, row, header.columns[c], row.cells[c], decimal)
            if value is None:
                words.setdefault(row.cells[c].strip(), []).append((row, c))
            values[i, k] = np.nan if value is None else value
    for places in words.values():  # a program writes its word for a gap into each coordinate
        if len(places) < _FEWEST_MISSING:
            row, c = places[0]
            raise _number_error(path, row, header.columns[c], row.cells[c], decimal)
    return values, [
        f"{path}:{places[0][0].line}: {reprlib.repr(word)} stands in {len(places)} cells of "
        "numbers: nothing was seen there"
        for word, places in words.items()
    ]


def _number_error(
    path: Path, row: Row, column: CapturedColumn, cell: str, decimal: Decimal
) -> InputError:
    hint = "give one, or nothing where nothing was seen"
    if re.fullmatch(r"\s*[-+]?\d{1,3}([.,]\d{3})+[.,]?\d*\s*", cell):
        hint = "write numbers without separators of thousands"
    elif re.search(r"\d", cell) and ("," in cell or "." in cell):
        hint = f"the decimal mark of this file is {decimal!r}; use one mark throughout"
    elif re.fullmatch(r"\s*[-+]?[0-9.,]+\s*[^\d\s.,]+\s*", cell):
        hint = "write the number alone, and its unit in the column's name"
    message = f"{reprlib.repr(cell.strip())} is not a number; {hint}"
    return InputError.at(path, message, line=row.line, key=column.name)
