"""What a person enters for the settings, checked before anything is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.web.draft import Draft, value_text
from cell.web.wording import translation

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"


@pytest.fixture
def draft() -> Draft:
    return Draft(CONFIG, CONFIG.read_text("utf-8"))


def enter(draft: Draft, name: str, typed: str) -> None:
    draft.enter(next(e for e in draft.entries() if e.name == name), typed)


def test_what_is_entered_changes_the_text_and_can_be_taken_back(draft: Draft) -> None:
    enter(draft, "motion.hold_s", "0.8")
    assert draft.problems() == ()
    assert "-  hold_s: 1.0\n+  hold_s: 0.8" in draft.differences()
    assert draft.summary() == "motion.hold_s: 1.0 → 0.8"
    enter(draft, "motion.hold_s", "1")
    assert (draft.differences(), draft.changes) == ("", {})
    enter(draft, "motion.hold_s", "")
    assert "hold_s" not in draft.text and draft.summary() == "motion.hold_s: 1.0 → default"


@pytest.mark.parametrize(
    ("name", "typed", "said"),
    [
        ("motion.hold_s", "31", "less than or equal to 30"),
        ("motion.hold_s", "0,8", "write a decimal point"),
        ("motion.hold_s", "", ""),
        ("limits.x_m", "", "missing"),
        ("limits.x_m", "[1, 2", "expected ',' or ']'"),
        ("limits.x_m", "1\nretry: 2", "no value in one line"),
        ("camera.kind", "opencv", "a real device cannot act in the simulated world"),
        ("motion.lower_m", "0.9", "outside limits.y_m"),
    ],
)
def test_what_check_says_is_told_for_the_entry(
    draft: Draft, name: str, typed: str, said: str
) -> None:
    enter(draft, name, typed)
    found = [problem for key, problem in draft.problems() if key == name]
    assert any(said in problem for problem in found) if said else not found


def test_changes_are_made_to_another_text(draft: Draft) -> None:
    enter(draft, "motion.lowering.jerk_m_per_s3", "100")
    enter(draft, "calibration", "used")
    other = draft.on(draft.base.replace("lower_s: 0.3", "lower_s: 0.4"))
    assert "lower_s: 0.4" in other.text and other.changes == draft.changes
    assert other.differences().count("\n-") == 1 + draft.differences().count("\n-  lowering") - 1


def test_another_kind_of_device_forgets_what_was_entered_for_the_former(draft: Draft) -> None:
    enter(draft, "camera.read_noise", "2.0")
    enter(draft, "camera.kind", "opencv")
    said = dict(draft.problems())
    assert "unknown key" in said["camera.read_noise"]


def test_values_are_shown_as_the_file_has_them_in_every_language() -> None:
    said = [value_text(value, translation("de")) for value in ("0.8", "failed", "used")]
    assert said == ["0.8", "failed", "verwendet"]
