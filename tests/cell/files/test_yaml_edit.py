"""Single entries of a YAML text are changed, and nothing else in it."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cell.files.input_error import InputError
from cell.files.yaml_document import document_of
from cell.files.yaml_edit import UNSET, Names, edited

FILE = Path("cell.yaml")
TEXT = """\
# heading
motion:            # of the gripper
  home: {x_m: 0.0, y_m: 0.0}   # where
  paces:
    # slow ones
    - 1.5
    - 2.0
  hold:
limits:
  x_m: [-0.06, 0.02]

  # last words
"""
CHANGES: list[tuple[Names, object, str, str]] = [
    (("motion", "home", "x_m"), 0.01, "{x_m: 0.0, y", "{x_m: 0.01, y"),
    (("motion", "home", "x_m"), UNSET, "{x_m: 0.0, y_m", "{y_m"),
    (("motion", "home", "y_m"), UNSET, ", y_m: 0.0}", "}"),
    (("motion", "home", "angle_rad"), 0.5, "y_m: 0.0}", "y_m: 0.0, angle_rad: 0.5}"),
    (("motion", "hold"), {"least_s": 0.4}, "  hold:\n", "  hold: {least_s: 0.4}\n"),
    (("motion", "hold", "least_s"), 0.4, "  hold:\n", "  hold: {least_s: 0.4}\n"),
    (("motion", "hold"), UNSET, "  hold:\n", ""),
    (
        ("motion", "paces"),
        [3.0],
        "paces:\n    # slow ones\n    - 1.5\n    - 2.0\n",
        "paces: [3.0]\n",
    ),
    (("limits", "x_m"), UNSET, "  x_m: [-0.06, 0.02]\n", "  {}\n"),
    (("limits", "y_m"), [0, 1], "0.02]\n", "0.02]\n  y_m: [0, 1]\n"),
    (("retry",), 1, "0.02]\n", "0.02]\nretry: 1\n"),
    (("vision", "nodes"), 9, "0.02]\n", "0.02]\n\nvision:\n  nodes: 9\n"),
    (("nothing", "there"), UNSET, "", ""),
]


@pytest.mark.parametrize(("key", "value", "before", "after"), CHANGES)
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_one_entry_is_changed(
    key: Names, value: object, before: str, after: str, ends: str
) -> None:
    wanted = TEXT.replace(before, after, 1)
    found = edited(FILE, "\ufeff" + TEXT.replace("\n", ends), {key: value})
    assert found == "\ufeff" + wanted.replace("\n", ends)


def test_what_an_alias_shares_is_not_changed() -> None:
    text = "a: &shared {x: 1}\nb: *shared\n"
    with pytest.raises(InputError, match=r"b\.x: cannot be changed by itself"):
        edited(FILE, text, {("b", "x"): 2})


_VALUES = st.one_of(
    st.integers(), st.floats(allow_nan=False), st.booleans(), st.none(), st.text(max_size=8)
)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([c[0] for c in CHANGES]), st.one_of(_VALUES, st.lists(_VALUES, max_size=3)))
def test_what_is_written_reads_back(key: Names, value: object) -> None:
    try:
        found = document_of(edited(FILE, TEXT, {key: value}), FILE).data
    except InputError as error:  # a text that YAML has no place for in one line
        assert "by itself" in str(error)
        return
    for name in key:
        found = found[name]
    assert found == value
