"""What counts as the law of a study found."""

import pytest

from cell.lab.data.results import Interval
from cell.lab.next.discover import Discovery
from cell.lab.next.terms import admissible
from tools.studies import discover_study
from tools.worlds.outside_laws import LATER, LAWS


def test_each_law_but_a_shaking_table_has_a_term() -> None:
    firsts = {t.numbers[0].name for t in admissible((-0.1, 0.0, -0.1, 0.0))}
    assert set(discover_study.FAMILY.values()) <= firsts
    assert set(discover_study.FAMILY) == set(LAWS) - set(LATER) - {"shaking"}


@pytest.mark.parametrize(
    ("parameter", "after_m", "right"),
    [("power_drag", 1.2e-4, True), ("power_drag", 1.4e-4, False), ("wind_drag", 1e-4, False)],
)
def test_a_law_is_right_by_its_family_and_by_what_it_leaves(
    monkeypatch: pytest.MonkeyPatch, parameter: str, after_m: float, right: bool
) -> None:
    def found(*_: object) -> Discovery:
        parameters = {parameter: Interval(1.0, 0.9, 1.1, "1")}
        return Discovery("law", parameters, ("a law",), 1e-4, 1e-3, after_m, True, True, "")

    monkeypatch.setattr(discover_study, "make_study", lambda *_, **__: None)
    monkeypatch.setattr(discover_study, "fits_of", lambda _: None)
    monkeypatch.setattr(discover_study, "discover", found)
    assert discover_study.is_right("cubic_drag", 1, 1.0) is right


@pytest.mark.parametrize(("given", "asked"), [([], 10), (["lift", "jet"], 2)])
def test_the_target_asks_for_the_ten_laws_unless_some_are_named(
    monkeypatch: pytest.MonkeyPatch, given: list[str], asked: int
) -> None:
    """Without a name it ended with "invalid choice"."""
    names: list[str] = []

    def is_right(name: str, *_: object) -> bool:
        names.append(name)
        return len(names) != 1

    monkeypatch.setattr(discover_study, "is_right", is_right)
    monkeypatch.setattr("sys.argv", ["discover", *given])
    assert discover_study.main() == (0 if asked == 10 else 1)  # eight of ten, or all that are named
    assert len(set(names)) == asked
