"""Which programs the service starts beside the cell."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from cell.settings.plant import Plant


def test_what_is_started_has_its_section() -> None:
    assert Plant().start == ()
    assert Plant.model_validate({"start": ["opcua"], "opcua": {}}).start == ("opcua",)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"start": ["mqtt"]}, "start names mqtt, which has no section; add mqtt: to plant"),
        ({"start": ["opcua", "opcua"], "opcua": {}}, "start names opcua twice; once is enough"),
        ({"start": ["profinet"]}, "'opcua', 'mqtt' or 'handshake'"),
    ],
)
def test_what_cannot_be_started_is_refused(said: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Plant.model_validate(said)
