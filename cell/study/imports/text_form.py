"""Form of a text table: detects the separator of its cells and its decimal mark."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import Decimal, TextForm, number
from cell.study.imports.text_rows import split_line

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
