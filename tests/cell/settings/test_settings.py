"""Every mistake in the settings is found before anything moves, and named where it stands."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from cell.files.input_error import InputError
from cell.records.result import Outcome
from cell.settings import Settings, load_settings
from cell.settings.check import freedoms
from cell.settings.devices import SimulatedCamera
from cell.settings.records import ENDINGS
from cell.settings.translate import vision_of
from cell.vision.detect import VisionOptions
from cell.vision.marks import JawMarks
from cell.wiring.twins import camera_twin

CONFIG = Path(__file__).parents[3] / "config"
FAKE = (CONFIG / "fake.yaml").read_text(encoding="utf-8")
LINE3 = (CONFIG / "line3.yaml").read_text(encoding="utf-8")
EMULATED = (CONFIG / "emulated.yaml").read_text(encoding="utf-8")


def complaint(tmp_path: Path, text: str) -> str:
    path = tmp_path / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_settings(path)
    assert all(str(p).startswith(f"{path}:{p.line}:{p.column}: ") for p in caught.value.problems)
    return str(caught.value)


@pytest.mark.parametrize("name", ["fake.yaml", "line3.yaml", "emulated.yaml", "products.yaml"])
def test_the_shipped_settings_are_valid(name: str) -> None:
    settings = load_settings(CONFIG / name)
    assert len(settings.motion.offsets.values_m) == 21
    assert settings.motion.offsets.values_m[-1] == pytest.approx(0.04)


def test_what_is_resolved_can_be_loaded_again(tmp_path: Path) -> None:
    settings = load_settings(CONFIG / "line3.yaml")
    path = tmp_path / "resolved.yaml"
    path.write_text(yaml.safe_dump(settings.model_dump(mode="json")), encoding="utf-8")
    assert load_settings(path) == settings


def test_every_entry_has_a_sentence() -> None:
    schema = Settings.model_json_schema()
    sections = {"": schema, **schema["$defs"]}
    silent = [
        f"{name}.{key}"
        for name, section in sections.items()
        for key, entry in section.get("properties", {}).items()
        if not {"description", "$ref", "const"} & entry.keys()
    ]
    assert silent == []


def test_the_schema_for_editors_is_fresh_and_accepts_what_is_shipped() -> None:
    schema = json.loads((CONFIG / "cell.schema.json").read_text(encoding="utf-8"))
    assert schema == Settings.model_json_schema(), "run `cell schema > config/cell.schema.json`"
    for text in (FAKE, LINE3, EMULATED):
        jsonschema.validate(yaml.safe_load(text), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(yaml.safe_load(FAKE.replace("force_n", "force")), schema)


def test_what_is_not_said_of_the_pictures_is_what_vision_takes_for_granted() -> None:
    settings = load_settings(CONFIG / "fake.yaml")
    assert vision_of(settings) == VisionOptions(free_length_m=settings.cable.free_length_m)


def test_what_is_said_of_the_pictures_reaches_vision_and_the_simulated_camera(
    tmp_path: Path,
) -> None:
    discs = ((0.01, 0.012), (0.01, -0.012), (0.05, 0.002))
    path = tmp_path / "cell.yaml"
    said = (
        "vision: {cable_is: light, min_contrast: 9, line_width_px: 1.5, nodes: 15,\n"
        "  length_tolerance_m: 0.004, jaw: {radius_m: 0.003,\n"
        "  discs_m: [[0.01, 0.012], [0.01, -0.012], [0.05, 0.002]]}}\n"
    )
    path.write_text(FAKE + said, encoding="utf-8")
    settings = load_settings(path)
    marks = JawMarks(discs, 0.003)
    assert vision_of(settings) == VisionOptions(0.1, 0.004, 15, "light", 9.0, 1.5, marks)
    assert isinstance(settings.camera, SimulatedCamera)
    picture = camera_twin(settings, settings.camera, 1).picture
    assert picture.marks_m == tuple((*centre, 0.003) for centre in discs)
    assert picture.cable_level > picture.background_level
    x0, y0, x1, y1 = picture.plate_m
    assert all(x0 < x - 0.003 and x + 0.003 < x1 for x, _ in discs)
    assert all(y0 < y - 0.003 and y + 0.003 < y1 for _, y in discs)


SQUARE = "vision: {jaw: {discs_m: [[0.01, 0.01], [0.01, -0.01], [0.03, 0.01], [0.03, -0.01]]}}\n"

MISTAKES = [
    ("camera:\n", f"{SQUARE}camera:\n", "must differ by at least 1.0 mm each; move a mark"),
    ("camera:\n", "vision: {nodes: 2}\ncamera:\n", "vision.nodes: input should be greater"),
    ("camera:\n", "vision: {cable_is: grey}\ncamera:\n", "vision.cable_is: "),
    # old, new, what is said
    (
        "force_n: 20.0",
        "force: 20.0",
        "cell.yaml:47:3: gripper.force: unknown key; did you mean 'force_n'?",
    ),
    (
        "force_n: 20.0",
        "force_n: 20 N",
        "cell.yaml:47:3: gripper.force_n: input should be a valid number",
    ),
    ("force_n: 20.0", "force_n: 20 N", "write the number alone, its unit is in the key's name"),
    ("force_n: 20.0", "force_n: 500", "less than or equal to 235 (got 500)"),
    ("force_n: 20.0", "force_n: 60", "60 N is outside gripper.force_limits_n = [1, 40]"),
    ("force_n: 20.0", "force_n: .nan", "gripper.force_n: "),
    ("  force_n: 20.0", "", "gripper.force_n: is missing"),
    ("gripper:", "griper:", "griper: unknown key; did you mean 'gripper'?"),
    ("motion:\n", "", "destination.lower_s: unknown key; write it under motion"),
    ("  x_m: [-0.135, -0.130]", "  zzz: 1", "zzz: unknown key; use one of those known here: x_m"),
    ("free_length_m: 0.100", "free_length_mm: 100", "did you mean 'free_length_m'?"),
    ("free_length_m: 0.100", "free_length_m: 100", "cable.free_length_m: input should be less"),
    ("free_length_m: 0.100", "free_length_m: 100", "(got 100); give metres, not millimetres"),
    ("kg_per_m: 0.0074", "kg_per_m: 74", "(got 74); give kg/m, not g/m"),
    ("kg_per_m: 0.0074", "kg_per_m: 7.4", "is 4.62e+06 kg/m³, not 20 … 25000; give kg/m, not g/m"),
    ("thickness_m: 0.0001", "thickness_m: 0.1", "is 4.62 kg/m³, not 20 … 25000"),
    ("  velocity_m_per_s: 0.6", "  velocity_m_per_s: 600", "limits.velocity_m_per_s: input should"),
    ("  velocity_m_per_s: 0.6", "  velocity_m_per_s: 60", "(got 60); give m/s, not mm/s"),
    ("lag_s: 0.03", "lag_s: 30", "(got 30); give seconds, not milliseconds"),
    ("lag_s: 0.03", "lag_s: 0.03\n  noise_m: 0.1", "(got 0.1); give metres, not millimetres"),
    ("angle_rad: 0.0}", "angle_rad: 45}", "(got 45); give radians, not degrees"),
    ("y_m: [-0.111, -0.101]", "y_m: [-0.101, -0.111]", "is not a range; give [lower, upper]"),
    ("y_m: [-0.111, -0.101]", "y_m: [-0.111, -0.111]", "[lower, upper], two numbers that differ"),
    ("y_m: [-0.111, -0.101]", "y_m: [0.505, 0.515]", "destination.y_m: [0.505, 0.515] is out of"),
    ("x_m: [-0.135, -0.130]", "x_m: [-0.430, -0.420]", "entry edge -0.42 m is out of reach"),
    ("x_m: [-0.135, -0.130]", "x_m: [0.130, 0.140]", "lies behind the gripper"),
    ("origin_column_px: 1000", "origin_column_px: 500", "is not all in the picture, which shows"),
    ("last_m: 0.040", "last_m: 0.060", "motion.offsets.last_m: takes the gripper to y_m = -0.11"),
    ("last_m: 0.040", "last_m: -0.01", "motion.offsets.last_m: input should be greater"),
    ("step_m: 0.002", "step_m: 0.003", "0.003 m does not divide 0 … 0.04 m"),
    ("step_m: 0.002", "step_m: 0.00002", "makes 2000 offsets, limit 1000"),
    ("first_m: 0.0,", "first_m: 0.05,", "0.04 m is less than first_m = 0.05 m"),
    (
        "advance_m: 0.050",
        "advance_m: 0.070",
        "takes the gripper to x_m = -0.07, outside limits.x_m",
    ),
    (
        "advance_m: 0.050",
        "advance_m: 0.050\n  start: {window_s: 0.2, further_m: 0.02}",
        "takes the gripper to x_m = -0.07, outside limits.x_m",
    ),
    (
        "advance_m: 0.050",
        "advance_m: 0.050\n  aside: {x_m: 0.015, y_m: -0.05, angle_rad: 1.5}",
        "motion.aside.angle_rad: takes the gripper to angle_rad = 1.5, outside limits.angle_rad",
    ),
    (
        "velocity_m_per_s: 0.6",
        "velocity_m_per_s: 0.4",
        "motion.lowering.velocity_m_per_s: 0.5 is beyond limits.velocity",
    ),
    ("angle_rad: [-0.6, 1.1]", "angle_rad: [0.1, 0.2]", "outside limits.angle_rad = [0.1, 0.2]"),
    ("kind: sim", "kind: simm", "'simm' is not one of 'sim', 'ur'; did you mean 'sim'?"),
    ("  kind: sim\n  rate", "  rate", "arm.kind: is missing"),
    ("rate_hz: 500.0", "rate: 500.0", "arm.rate: unknown key; did you mean 'rate_hz'?"),
    ("kind: sim\n  force", "kind: serial\n  port: p\n  force", "make all three `sim`, or none"),
    ("frame_rate_hz: 200.0", "frame_rate_hz: 1000\n  exposure_s: 0.002", "longer than a frame"),
    ("exponent: [0.95, 1.05]", "exponent: [0.95]", "world.exponent[1]: is missing"),
    ("effects: {}", "effects: {air_drga: {}}", "unknown effect; did you mean 'air_drag'?"),
    ("effects: {}", "effects: {tip_mass: {kg: 1}}", "tip_mass has no parameter 'kg'; it has"),
    (
        "effects: {}",
        "effects: {tip_mass: {mass_kg: -1}}",
        "tip_mass.mass_kg = -1 kg: must be 0 … 10 kg",
    ),
    ("cable:\n", "cable:\n\tx: 1\n", ":6:1: is not YAML"),
    ("free_length_m: 0.100", "free_length_m: true", "should be a valid number (got True)"),
    ("hold_s: 1.0", "hold_s: 1e6", "motion.hold_s: input should be less than or equal to 30"),
    ("hold_s: 1.0", "hold_s: 29", "motion.hold_s: 29 s at 200 Hz makes 5900 frames"),
    (
        "frame_rate_hz: 200.0",
        "frame_rate_hz: 30.0",
        "motion.still_s: 0.2 s at 30 Hz makes 6 frames of the cable at rest; its noise is known "
        "from 8 or more, and without them every cable is rejected: give 0.27 s or more",
    ),
    (
        "gripper:\n",
        "ledger:\n  shifts: ['06:00', 'noon']\ngripper:\n",
        "'noon' is no time of a day",
    ),
    (
        "gripper:\n",
        "ledger:\n  shifts: ['06:00', '14:00+01:00']\ngripper:\n",
        "'14:00+01:00' is no time of a day; write it as '06:00'",
    ),
    ("y_m: [-0.111, -0.101]", "y_m: [-0.1110001, -0.111]", "less than the cable's thickness"),
    ("x_m: [-0.135, -0.130]", "x_m: [-0.1300001, -0.130]", "[-0.1300001, -0.13] is 1e-07 m wide"),
    ("x_m: [-0.06, 0.02]", "x_m: [-60, 20]", "limits.x_m[0]: input should be greater than or"),
    ("[1.5e-5, 5.0e-5]", "[-1, 5]", "world.rigidity_n_m2[0]: input should be greater than 0"),
]


@pytest.mark.parametrize(("old", "new", "said"), MISTAKES, ids=[m[2][-30:] for m in MISTAKES])
def test_a_mistake_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in FAKE
    assert said in complaint(tmp_path, FAKE.replace(old, new, 1))


def test_a_mistyped_key_is_one_mistake(tmp_path: Path) -> None:
    told = complaint(tmp_path, FAKE.replace("force_n", "force"))
    assert len(told.splitlines()) == 1


def test_an_entry_that_may_be_one_of_two_things_has_one_complaint(tmp_path: Path) -> None:
    """It was said of `motion.start.StartSettings` and of `motion.start.literal['auto']`."""
    told = complaint(tmp_path, FAKE.replace("motion:", "motion:\n  start: sometimes", 1))
    assert len(told.splitlines()) == 1
    assert "motion.start: must hold entries" in told
    assert "; or input should be 'auto'" in told


def test_axes_that_are_not_square_are_refused(tmp_path: Path) -> None:
    text = LINE3.replace("[0.0, 0.0, 1.0]", "[0.0, 0.6, 0.8]")
    assert "is not perpendicular to plane_y_axis" in complaint(tmp_path, text)


@pytest.mark.parametrize("force", ["10.0", "240.0"])
def test_a_force_that_the_gripper_cannot_do_is_refused(tmp_path: Path, force: str) -> None:
    text = LINE3.replace("force_n: 20.0", f"force_n: {force}").replace("[20.0, 40.0]", "[5, 500]")
    assert "gripper.force_n: input should be" in complaint(tmp_path, text)


def test_all_mistakes_are_told_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = FAKE.replace("width_m", "widht_m").replace("force_n", "force").replace("lag_s", "lag")
    told = complaint(tmp_path, text).splitlines()
    places = [int(line.split(":")[1]) for line in told]
    assert len(told) == 3
    assert places == sorted(places)


def test_a_file_that_is_not_there_or_empty_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml:1:1: cannot be read: No such file"):
        load_settings(tmp_path / "nowhere.yaml")
    assert "cable: is missing" in complaint(tmp_path, "")
    assert "must hold `key: value` lines" in complaint(tmp_path, "- a\n- b\n")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("host: 127.0.0.2", "host: 192.168.3.10", "arm.host: 192.168.3.10 is no loopback address"),
        (
            "device: tcp://127.0.0.2:5600",
            "device: 0",
            "camera.device: 0 is not where an emulator may be",
        ),
        (
            "port: /tmp/cable-cell-gripper ",
            "port: /dev/ttyUSB0 ",
            "gripper.port: /dev/ttyUSB0 may be a real line",
        ),
        (
            "  damping_ratio: [0.02, 0.06]",
            "  damping_ratio: [0.02, 0.06]\n  effects: {robot_lag: {delay_s: 0.005}}",
            "world.effects.robot_lag: cannot be shown live",
        ),
    ],
)
def test_nothing_real_is_emulated_by_mistake(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in EMULATED
    assert said in complaint(tmp_path, EMULATED.replace(old, new))


def test_a_hold_as_long_as_needed_is_said_once(tmp_path: Path) -> None:
    hold = "  hold: {least_s: 0.4, most_s: 0.8}\n"
    text = FAKE.replace("  hold_s: 1.0\n", hold)
    (tmp_path / "good.yaml").write_text(text, encoding="utf-8")
    assert load_settings(tmp_path / "good.yaml").motion.longest_hold_s == 0.8
    said = complaint(tmp_path, FAKE.replace("  hold_s: 1.0\n", f"  hold_s: 1.0\n{hold}"))
    assert "hold_s 1 contradicts hold.most_s 0.8; remove hold_s" in said
    said = complaint(tmp_path, text.replace("most_s: 0.8", "most_s: 29"))
    assert "motion.hold.most_s: 29 s at 200 Hz makes 5900 frames of a swing, limit 5000" in said
    said = complaint(tmp_path, text.replace("least_s: 0.4", "least_s: 0.9"))
    assert "least_s 0.9 is longer than most_s 0.8; lower least_s" in said


def test_only_what_has_an_emulator_is_emulated(tmp_path: Path) -> None:
    text = complaint(tmp_path, FAKE + "\nemulated: {}\n")
    for section in ("arm", "camera", "gripper"):
        assert f"{section}.kind: 'sim' has no emulator" in text


def test_every_outcome_may_be_kept() -> None:
    """The settings name the outcomes of a cycle; they know nothing of records."""
    assert set(ENDINGS) == {outcome.value for outcome in Outcome}


@pytest.mark.parametrize(
    ("entry", "given", "said"),
    [
        ("tcp", "[0, 0, 160, 0, 0, 0]", "160 m off the flange, at most 1 m; give x, y and z in m"),
        ("tcp", "[0, 0, 0.16, 0, 90, 0]", "length 90, at most 2π; give rx, ry and rz in radians"),
        ("plane_origin_m", "[450, -120, 380]", "-3 (got -120); give metres, not millimetres"),
        ("plane_x_axis", "[0, -2, 0]", "has length 2, a direction has length 1; give [0.0, -1.0"),
        ("plane_y_axis", "[0, 0, 0]", "is no direction; give one of length 1, such as [0, -1, 0]"),
        ("port", "socket://10.0.0.3", "is no line; give a device such as /dev/ttyUSB0, or socket:"),
        ("port", "socket://10.0.0.3:70000", "is no line; give a device such as /dev/ttyUSB0, or s"),
        ("port", "socket://10.0.0.3:63352", "give `kind: urcap` and `host: 10.0.0.3` instead of"),
    ],
)
def test_a_place_that_no_arm_has_is_refused(
    tmp_path: Path, entry: str, given: str, said: str
) -> None:
    text, count = re.subn(rf"(?m)^  {entry}: [^#\n]*", f"  {entry}: {given} ", LINE3)
    assert count == 1 and said in complaint(tmp_path, text)


def test_a_line_may_be_reached_through_a_network(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(re.sub("port: /dev/[^ #\n]*", "port: socket://10.0.0.3:54321", LINE3))
    assert load_settings(path).gripper.port == "socket://10.0.0.3:54321"  # type: ignore[union-attr]


def numbers_without_a_range(
    schema: Any, defs: Any, key: str, seen: frozenset[str]
) -> Iterator[str]:
    """Keys of numbers in a JSON schema that have no lower or no upper limit."""
    if "$ref" in schema:
        name = schema["$ref"].split("/")[-1]
        if name not in seen:
            yield from numbers_without_a_range(defs[name], defs, key, seen | {name})
        return
    for inner in (
        *schema.get("anyOf", ()),
        *schema.get("oneOf", ()),
        *schema.get("prefixItems", ()),
    ):
        yield from numbers_without_a_range(inner, defs, key, seen)
    for name, inner in schema.get("properties", {}).items():
        yield from numbers_without_a_range(inner, defs, name, seen)
    for kind in ("items", "additionalProperties"):
        if isinstance(schema.get(kind), dict):
            yield from numbers_without_a_range(schema[kind], defs, key, seen)
    low, high = ({"minimum", "exclusiveMinimum"}, {"maximum", "exclusiveMaximum"})
    if schema.get("type") == "number" and not (low & schema.keys() and high & schema.keys()):
        yield key


def test_every_length_angle_time_and_pixel_has_a_plausible_range() -> None:
    """Or a number in another unit would be believed."""
    schema = Settings.model_json_schema()
    found = set(numbers_without_a_range(schema, schema["$defs"], "", frozenset()))
    units = ("_m", "_rad", "_s", "_px", "_n", "_hz", "_m_per_s", "_m_per_s2", "_m_per_s3")
    assert {k for k in found if k.endswith(units)} - WITHOUT_A_RANGE == set()


#: A press may take a minute, a broker a day.
WITHOUT_A_RANGE = {"ideal_cycle_s", "retry_s", "force_n"}


def test_a_start_is_free_unless_told_otherwise_and_a_check_says_so(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(FAKE.replace("motion:\n", "motion:\n  start: {}\n"))
    said = freedoms(load_settings(path), 0.0)
    assert said.startswith("starts at once, with one of the offsets; holds 1 s; feedback auto; ")
    assert said.endswith("serves openings of ±1.16 mm at best")  # half a step, 1.64 × 0.1 mm
    assert "the error of the camera's map" in freedoms(load_settings(path), None)
    for start in ("", "  start: auto\n", "  start: {window_s: 0.25, paces: [1.2, 1.3]}\n"):
        path.write_text(FAKE.replace("motion:\n", f"motion:\n{start}  hold: {{}}\n"))
        settings = load_settings(path)
        assert settings.motion.freedom.window_s == 0.25
        said = freedoms(settings, 0.0)
        paces = 2 if "paces" in start else 4
        assert f"up to 0.25 s later, between the offsets, {paces} slower paces" in said
        assert said.endswith("serves openings of ±0.16 mm at best")
