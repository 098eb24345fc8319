"""A replay says what came out otherwise, also what did not come out at all."""

from __future__ import annotations

from cell.wiring.replay import _differences, _ReplayedValues


def test_a_model_that_was_found_then_and_is_not_found_now_is_a_difference() -> None:
    """Of a cycle that was killed before it decided: nothing else tells."""
    model = {"parameters": [{"name": "rigidity_0", "value": 1e-4}]}
    then, nothing = _ReplayedValues(None, [model], None), _ReplayedValues(None, [], None)
    (said,) = _differences(then, nothing)
    assert (said.name, said.then, said.now) == ("models", 1, 0)
    assert _differences(nothing, then) == []  # a replay goes on where the recording ends
    assert _differences(then, then) == []
