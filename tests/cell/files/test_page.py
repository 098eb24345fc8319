"""Pages escape what they are given, need no network, and hold pictures and figures as data."""

import json
import math
from enum import StrEnum
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jinja2 import UndefinedError

from cell.files.figure_style import laid_out
from cell.files.page import PagePicture, Plot, code, page
from cell.files.plain import plain
from cell.files.table import TableData

TEMPLATE = """{% extends "page.html" %}{% from "parts.html" import table, plot, pictures %}
{% block content %}{{ table(rows) }}{{ plot(figure) }}{{ pictures(shown, 100) }}{% endblock %}"""
EVIL = "<script>alert('&')</script>"


def made(tmp_path: Path, **given: object) -> str:
    (tmp_path / "t.html").write_text(TEMPLATE, encoding="utf-8")
    figure = laid_out(go.Figure().add_scatter(x=[1], y=[2], name="</script>"), 300)
    content = {
        "rows": TableData("", ["a", EVIL], [["1", EVIL]], (0,)),
        "figure": Plot.of(figure),
        "shown": [PagePicture.of(np.zeros((10, 20, 3), np.uint8), 10, "one_two")],
    }
    return page(tmp_path, "t.html", EVIL, **(content | given))


def test_text_is_escaped_wherever_it_stands(tmp_path: Path) -> None:
    text = made(tmp_path)
    assert EVIL not in text
    assert text.count("&lt;script&gt;alert(&#39;&amp;&#39;)&lt;/script&gt;") == 4


def test_the_data_of_a_figure_ends_no_script(tmp_path: Path) -> None:
    data = made(tmp_path).partition('<script type="application/json">')[2]
    figure = json.loads(data[: data.index("</script>")])
    assert figure["data"][0]["name"] == "</script>"


def test_columns_of_numbers_stand_to_the_right_and_pictures_are_embedded(tmp_path: Path) -> None:
    text = made(tmp_path)
    assert "<td class='number'>1</td>" in text
    assert "alt='one two'" in text
    assert "src='data:image/jpeg;base64," in text


def test_what_a_template_lacks_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "t.html").write_text("{{ nothing }}", encoding="utf-8")
    with pytest.raises(UndefinedError):
        page(tmp_path, "t.html", "title")


def test_what_stands_between_backticks_is_code_and_is_escaped() -> None:
    assert code("a `b<c` d<e") == "a <code>b&lt;c</code> d&lt;e"


class Colour(StrEnum):
    RED = "red"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({"a": (1, 2.5)}, {"a": [1, 2.5]}),
        (np.array([[0.1, np.nan]]), [[0.1, None]]),
        (np.float64(0.3), 0.3),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (math.inf, None),
        ([Colour.RED, None, "x"], ["red", None, "x"]),
        (np.array(["a"]), ["a"]),
    ],
)
def test_becomes_what_json_writes(value: object, expected: object) -> None:
    """Each kind of value that results and messages hold."""
    assert json.loads(json.dumps(plain(value), allow_nan=False)) == expected


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_keeps_every_bit(values: list[float]) -> None:
    """Finite numbers are read back as they were."""
    assert json.loads(json.dumps(plain(np.array(values)))) == values
