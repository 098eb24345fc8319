"""Tables at every width: no number and no name is ever cut, brackets stay."""

import io

import pytest
from rich.console import Console

from cell.cable.effects import library
from cell.cli.output import show
from cell.files.table import TableData
from cell.lab.report.model_tables import effects_table

NAME = "20261122T015536.045-1_first"


TABLE = TableData(
    "Errors",
    ["trial", "late swing", "p (white)"],
    [[NAME, "0.00812345", "1.234e-186"], ["noise", "0.020", ""]],
    numbers=(1, 2),
)


def shown(part, width: int, terminal: bool = True) -> str:
    stream = io.StringIO()
    console = Console(file=stream, width=width, force_terminal=terminal, color_system=None)
    show(part, console=console)
    return stream.getvalue()


@pytest.mark.parametrize("width", [20, 40, 80, 200])
def test_nothing_is_cut_at_any_width(width: int) -> None:
    text = shown(TABLE, width)
    assert "0.00812345" in text and "1.234e-186" in text and "…" not in text
    letters = "".join(text.split())
    assert NAME in letters or all(part in letters for part in (NAME[:10], NAME[-5:]))


def test_a_narrow_terminal_gets_a_line_for_each_value() -> None:
    lines = shown(TABLE, 20).splitlines()
    assert f"trial: {NAME}" in lines
    assert "p (white): 1.234e-186" in lines
    assert "late swing: 0.020" in lines


def test_off_a_terminal_a_table_is_as_wide_as_it_needs() -> None:
    (line,) = [x for x in shown(TABLE, 20, terminal=False).splitlines() if NAME in x]
    assert "1.234e-186" in line


@pytest.mark.parametrize("width", [40, 80, 200])
def test_units_in_brackets_are_printed(width: int) -> None:
    text = shown(effects_table(library()), width)
    assert "[s]" in text and "[1]" in text and "[kg]" in text
    assert "[s]" in shown("lasts 3 [s]", width)
