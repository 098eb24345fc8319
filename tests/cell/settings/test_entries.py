"""Entries of a form: what can be set, with explanation, limits, default and present value."""

from __future__ import annotations

from pathlib import Path

from cell.files.yaml_document import read_yaml
from cell.files.yaml_edit import UNSET
from cell.settings.entries import SettingsEntry, SettingsForm, change_for, entries
from cell.settings.starting import answered

CONFIG = Path(__file__).parents[3] / "config"


def named(name: str, **sections: object) -> SettingsEntry:
    data = {**read_yaml(CONFIG / "fake.yaml").data, **sections}
    return next(e for e in entries(data) if e.name == name)


def test_an_entry_has_explanation_limits_unit_and_default() -> None:
    entry = named("motion.decide_s")
    assert entry.explained.startswith("Time between the last frame")
    assert (entry.limits, entry.unit, entry.default) == ("≥ 0, ≤ 30", "s", 0.2)
    assert (entry.given, entry.value, entry.form) == (False, 0.2, SettingsForm.YAML)
    assert named("feedback").choices == {"auto": "auto", "off": "off", "on": "on"}
    assert named("limits.x_m").default is UNSET
    assert named("limits.x_m").shown([-0.06, 0.02]) == "[-0.06, 0.02]"


def test_a_default_of_a_whole_section_is_that_of_its_entries() -> None:
    assert named("motion.aside.x_m").value == 0.015
    assert named("motion.aside.x_m", motion={"aside": {"y_m": -0.1}}).value == 0.0
    assert named("motion.insertion.jerk_m_per_s3", motion={}).default == 10.0


def test_of_a_device_the_entries_of_its_kind_are_listed() -> None:
    assert named("camera.kind").choices.keys() == {"files", "genicam", "opencv", "sim"}
    assert named("camera.lens_blur_px").value == 0.6
    assert named("camera.device", camera={"kind": "opencv"}).value == 0


def test_a_section_may_be_left_out_as_a_whole() -> None:
    data = read_yaml(CONFIG / "fake.yaml").data
    names = {e.name for e in entries(data)}
    assert "calibration" in names and "calibration.folder" not in names
    assert "calibration.folder" in {e.name for e in entries({**data, "calibration": {}})}
    assert "recording.keep" not in {e.name for e in entries({**data, "recording": None})}


def test_a_section_that_begins_keeps_what_held_by_default() -> None:
    data = read_yaml(CONFIG / "fake.yaml").data
    assert change_for(data, ("motion", "aside", "x_m"), 0.01) == {
        ("motion", "aside", "x_m"): 0.01,
        ("motion", "aside", "y_m"): -0.05,
    }
    assert change_for(data, ("recording", "memory_mb"), 64) == {("recording", "memory_mb"): 64}


def test_what_a_new_file_has_is_in_the_form() -> None:
    for kind in ("simulated", "emulated", "real"):
        data = answered(kind, {})  # type: ignore[arg-type]
        known = {e.key for e in entries(data)}
        assert {(s, k) for s, v in data.items() if isinstance(v, dict) for k in v} <= known | {
            (e[0], e[1]) for e in known if len(e) > 2
        }
