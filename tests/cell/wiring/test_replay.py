"""A replay says what came out otherwise, also what did not come out at all."""

from __future__ import annotations

from cell.records.recording import form
from cell.wiring.replay import _differences


class Recorded:
    """The models of a recording that has nothing else."""

    def __init__(self, *models: dict[str, object]) -> None:
        self._models = models

    def json(self, topic: str) -> list[dict[str, object]]:
        return list(self._models) if topic == form.MODEL else []

    def last(self, topic: str) -> None:
        return None


def test_a_model_that_was_found_then_and_is_not_found_now_is_a_difference() -> None:
    """Of a cycle that was killed before it decided: nothing else tells."""
    model = {"parameters": [{"name": "rigidity_0", "value": 1e-4}]}
    then, nothing = Recorded(model), Recorded()
    (said,) = _differences(then, nothing)
    assert (said.name, said.then, said.now) == ("models", 1, 0)
    assert _differences(nothing, then) == []  # a replay goes on where the recording ends
    assert _differences(then, then) == []
