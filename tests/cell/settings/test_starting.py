"""Settings to start from are those that are shipped, and load with a comment beside each entry."""

from pathlib import Path

import pytest

from cell.settings import Settings, load_settings
from cell.settings.starting import STARTING, answered, commented, default, questions

CONFIG = Path(__file__).parents[3] / "config"


@pytest.mark.parametrize(("kind", "shipped"), [("simulated", "fake"), ("real", "line3")])
def test_what_init_starts_from_is_what_is_shipped(kind, shipped) -> None:
    made = Settings.model_validate(STARTING[kind]).model_dump()
    there = load_settings(CONFIG / f"{shipped}.yaml").model_dump()
    there["camera"] |= {"serial_number": None} if kind == "real" else {}
    assert made == there


@pytest.mark.parametrize("kind", ["simulated", "real"])
def test_the_file_loads_as_the_settings_and_explains_what_is_described(kind, tmp_path) -> None:
    settings = Settings.model_validate(STARTING[kind])
    path = tmp_path / "cell.yaml"
    text = commented(settings)
    path.write_text(text)
    assert load_settings(path) == settings
    assert max(len(line) for line in text.splitlines()) <= 130
    assert "Film of the swing, with the gripper held still; > 0, ≤ 30; default 1.0" in text
    assert ("world:" in text) == (kind == "simulated")


def test_answers_take_the_place_of_defaults_and_leave_these_alone() -> None:
    keys = {q.key for q in questions("real")}
    assert ("arm", "host") in keys and ("arm", "host") not in {
        q.key for q in questions("simulated")
    }
    made = answered("real", {("arm", "host"): "10.0.0.5", ("cable", "free_length_m"): 0.12})
    assert made["arm"]["host"] == "10.0.0.5" and made["cable"]["free_length_m"] == 0.12
    assert default("real", ("arm", "host")) == "192.168.3.10"
    assert default("simulated", ("cable", "free_length_m")) == 0.1
