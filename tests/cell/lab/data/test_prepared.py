"""A study keeps what was worked out of it, and another study begins with none of it."""

from dataclasses import replace

from cell.lab.data.prepared import PreparedStudy, once_per_study


def test_a_function_of_a_study_is_worked_out_once_for_each_study(make_study):
    asked = []

    @once_per_study
    def function(prepared: PreparedStudy, one: int, other: int = 0) -> int:
        asked.append((one, other))
        return one + other

    prepared = PreparedStudy.of(make_study(seed=2))
    assert [function(prepared, 1), function(prepared, 1), function(prepared, 2)] == [1, 1, 2]
    assert function(prepared, 1, other=5) == 6
    assert asked == [(1, 0), (2, 0), (1, 5)]
    changed = replace(prepared, slope_solver=prepared.solver)
    assert changed.memo == {}
    assert function(changed, 1) == 1
    assert asked[3:] == [(1, 0)]
