"""Where the settings say that independent fits are done."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from cell.settings.workers import Workers


@pytest.mark.parametrize(
    ("said", "place"),
    [
        ({}, None),
        ({"cores": 3}, 3),
        ({"cluster": "tcp://scheduler:8786"}, "tcp://scheduler:8786"),
    ],
)
def test_a_place_is_a_cluster_or_cores(said, place):
    assert Workers.model_validate(said).place == place


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"cluster": "scheduler:8786"}, "give 2, or tcp://host:8786"),
        ({"cluster": "3"}, "is no address of a scheduler; give tcp://host:8786"),
        ({"cores": 0}, "greater than or equal to 1"),
        ({"cluster": "tcp://a:1", "cores": 2}, "has both `cluster` and `cores`; leave one out"),
    ],
)
def test_what_is_no_place_is_refused(said, message):
    with pytest.raises(ValidationError, match=message):
        Workers.model_validate(said)
