"""Data as JSON knows it."""

import json
import math
from enum import StrEnum

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.files.plain import plain


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
