"""Settings of products: entries in place of the file's, mistakes named where they stand, ids."""

from __future__ import annotations

import re
import string
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cell.files.input_error import InputError
from cell.settings import load_settings
from cell.settings.calibrated import calibration_file
from cell.settings.loading import for_product, load_product, products_of
from cell.settings.product import pattern, product_for, product_of_part
from cell.settings.provenance import calibration_hash
from cell.settings.translate import model_hash

ROOT = Path(__file__).parents[3]
FAKE = (ROOT / "config" / "fake.yaml").read_text(encoding="utf-8")


def written(tmp_path: Path, products: str, base: str = FAKE) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(f"{base}\nproducts:\n{products}", encoding="utf-8")
    return path


def test_a_product_has_its_entries_and_the_files_for_the_rest() -> None:
    whole = load_settings(ROOT / "config" / "products.yaml")
    soft, stiff = products_of(whole).values()
    assert (soft.product, stiff.product, soft.products) == ("soft", "stiff", {})
    assert soft.cable == whole.cable and soft.destination == whole.destination
    assert stiff.cable.free_length_m == 0.09 and stiff.cable.width_m == whole.cable.width_m
    assert stiff.motion.hold_s == 0.9 and stiff.motion.offsets == whole.motion.offsets
    assert stiff.arm == whole.arm and stiff.limits == whole.limits
    assert model_hash(soft.model) != model_hash(stiff.model)


def test_the_settings_of_a_product_can_be_loaded_from_a_record(tmp_path: Path) -> None:
    stiff = load_product(ROOT / "config" / "products.yaml", "stiff")
    path = tmp_path / "settings.yaml"
    path.write_text(yaml.safe_dump(stiff.model_dump(mode="json")), encoding="utf-8")
    assert load_settings(path) == stiff == load_product(path, None)


@pytest.mark.parametrize(
    ("products", "key", "says"),
    [
        ("  A: {cable: {free_length_m: 3.0}}", "products.A.cable.free_length_m", "2"),
        ("  A: {cable: {free_lenght_m: 0.1}}", "products.A.cable.free_lenght_m", "did you mean"),
        ("  A: {cabel: {}}", "products.A.cabel", "did you mean 'cable'"),
        ("  A:\n    motion:\n      lower_m: 0.2", "products.A.motion.lower_m", "limits.y_m"),
        ("  A: {destination: {x_m: [-0.3, -0.29]}}", "products.A.destination.x_m", "out of reach"),
        ("  A: {cable: {free_length_m: 0.05}}", "destination.x_m", "with product A: entry edge"),
        (
            "  A: {model: {effects: [{effect: x}]}}",
            "products.A.model.effects[0].effect",
            "unknown",
        ),
        (
            "  A: {prior: {names: [exponent], mean: [1]}}",
            "products.A.prior.covariance",
            "missing",
        ),
        ("  A: {force_n: 1000.0}", "products.A.force_n", "less than or equal to 235"),
        ("  A: {part_ids: 'A-('}", "products.A.part_ids", "'A-(' is no pattern"),
        (r"  A: {part_ids: '(a+)+$'}", "products.A.part_ids", "'(a+)+$' can match an id in more"),
        ("  A: {part_ids: a}\n  B: {part_ids: a}", "products.B.part_ids", "is that of A too"),
        ("  A: {vision: {jaw: {radius_m: 0.003}}}", "products.A.vision.jaw", "belongs to the cell"),
        ("  a/b: {}", "products", "can be no product's name"),
        ("  A: {}\nproduct: B", "product", "'B' is no product"),
    ],
)
def test_mistakes_are_named_where_they_stand(
    tmp_path: Path, products: str, key: str, says: str
) -> None:
    path = written(tmp_path, products)
    with pytest.raises(InputError) as caught:
        load_settings(path)
    problem = next(p for p in caught.value.problems if p.key == key)
    assert says in problem.message
    last = re.split(r"[.\[]", key)[-1].rstrip("]")
    lines = path.read_text("utf-8").splitlines()
    assert last.isdigit() or "missing" in says or last in lines[problem.line - 1]


def test_mistakes_of_several_products_are_told_together(tmp_path: Path) -> None:
    path = written(tmp_path, "  A: {force_n: 1000.0}\n  B: {force_n: 2000.0}")
    with pytest.raises(InputError) as caught:
        load_settings(path)
    assert [p.key for p in caught.value.problems] == ["products.A.force_n", "products.B.force_n"]


def test_a_model_is_taken_whole_and_a_prior_stands_in_where_it_has_none(tmp_path: Path) -> None:
    base = f"{FAKE}\nmodel: {{effects: [{{effect: tip_mass}}]}}"
    prior = "{names: [exponent], mean: [1.0], covariance: [[0.0025]]}"
    other = "{names: [exponent], mean: [1.1], covariance: [[0.0025]]}"
    products = (
        f"  A: {{prior: {prior}}}\n  B: {{model: {{}}, prior: {prior}}}\n"
        f"  C: {{model: {{prior: {other}}}, prior: {prior}}}\n  D:\n"
    )
    path = written(tmp_path, products.replace("  D:\n", "  D: {}\n"), base)
    made = products_of(load_settings(path))
    effects = {name: [e.effect for e in s.model.effects] for name, s in made.items()}
    assert effects == {"A": ["tip_mass"], "B": [], "C": [], "D": ["tip_mass"]}
    means = {n: None if s.model.prior is None else s.model.prior.mean for n, s in made.items()}
    assert means == {"A": [1.0], "B": [1.0], "C": [1.1], "D": None}


def test_which_product_must_be_said_unless_the_file_does(tmp_path: Path) -> None:
    path = written(tmp_path, "  A: {}\n  B: {}")
    with pytest.raises(InputError, match="has A, B; say which one with --product"):
        load_product(path, None)
    with pytest.raises(InputError, match="'C' is no product of these settings; those are: A, B"):
        load_product(path, "C")
    with path.open("a") as file:
        file.write("\nproduct: B\n")
    assert load_product(path, None).product == "B"
    assert load_product(path, "A").product == "A"


def test_each_product_has_its_own_grip_and_all_share_the_camera(tmp_path: Path) -> None:
    folder = tmp_path / "calibration"
    folder.mkdir()
    text = FAKE.replace("view: {metres_per_pixel: 0.0002, ", "#")
    text = re.sub(r"\n  view: .*", "", FAKE)
    text += f"\ncalibration: {{folder: {folder}}}\n"
    text = text.replace(
        "world:  ",
        "world:\n  camera: {metres_per_pixel: 0.0002, origin_column_px: 1000, origin_row_px: 150}#",
    )
    whole = load_settings(written(tmp_path, "  A: {}\n  B: {}", text))
    a, b = (for_product(whole, name) for name in "AB")
    assert calibration_file(a, "grip") != calibration_file(b, "grip")
    assert calibration_file(a, "camera") == calibration_file(b, "camera")
    for file in (calibration_file(a, "camera"), calibration_file(a, "grip")):
        file.write_text("one")
    before = calibration_hash(a), calibration_hash(b)
    assert before[0] != before[1]
    calibration_file(b, "grip").write_text("other")
    assert calibration_hash(a) == before[0], "the grip of another product is none of its own"
    assert calibration_hash(b) != before[1]


NAMES = st.sampled_from(["A", "B", "C"])
IDS = st.text(string.ascii_uppercase + string.digits + "-", min_size=1, max_size=8)


@given(st.dictionaries(NAMES, st.none() | IDS.map(re.escape), max_size=3), IDS)
def test_an_id_means_one_product_or_is_refused(patterns: dict[str, str | None], part: str) -> None:
    matching = [n for n, p in patterns.items() if p is not None and re.fullmatch(p, part)]
    known = any(p is not None for p in patterns.values())
    if len(matching) == 1 or not known:
        assert product_of_part(patterns, part) == (matching[0] if matching else None)
    else:
        with pytest.raises(ValueError, match="matches part_ids of"):
            product_of_part(patterns, part)


@given(
    st.dictionaries(NAMES, st.none() | st.sampled_from(["A-.*", "B-.*", ".*"]), min_size=1),
    st.none() | NAMES,
    st.none() | st.sampled_from(["A-1", "B-1", "C-1"]),
    st.none() | NAMES,
)
def test_what_is_made_is_one_of_the_products_and_never_gainsays_an_id(
    patterns: dict[str, str | None], asked: str | None, part: str | None, usual: str | None
) -> None:
    usual = usual if usual in patterns else None
    try:
        made = product_for(patterns, asked, part, usual)
    except ValueError:
        return
    assert made in patterns
    assert asked in (None, made)
    said = [n for n, p in patterns.items() if part and p and re.fullmatch(p, part)]
    if len(said) == 1:
        assert made == said[0]


@pytest.mark.parametrize(
    ("asked", "part", "usual", "says"),
    [
        (None, None, None, "which product"),
        ("C", None, None, "'C' is no product; those are soft, stiff"),
        ("soft", "T-1", None, "part 'T-1' is of product stiff, not soft"),
        (None, "X-1", "soft", r"matches part_ids of no product: soft 'S-"),
    ],
)
def test_what_cannot_be_made_is_refused_with_the_remedy(
    asked: str | None, part: str | None, usual: str | None, says: str
) -> None:
    patterns = {"soft": r"S-\d+", "stiff": r"T-\d+"}
    with pytest.raises(ValueError, match=says):
        product_for(patterns, asked, part, usual)
    assert product_for(patterns, "soft", "X-1", None) == "soft", "an id of none gainsays no name"
    with pytest.raises(ValueError, match="soft and stiff; make the patterns narrower"):
        product_of_part({"soft": ".*", "stiff": "T.*"}, "T-1")


@pytest.mark.parametrize(
    "text",
    [
        "(a|a)*b",
        "(?:a|ab)+$",
        r"(\w+\d?)*-",
        "(?:a?){40}",
        "a?" * 40 + "b",
        ".*" * 9,
        "(?=(a+)+b)a",
    ],
)
def test_pattern_that_would_take_long_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="takes too long; give no repeat within a repeat"):
        pattern(text)


@pytest.mark.parametrize(
    "text", [r"S-\d+", r"[A-Z]+-\d+-\d+-\d+", r"(?:A|BC)-\w{1,9}", r"S(-\d{1,4}){0,3}", "a{300}"]
)
def test_accepted_pattern_refuses_the_longest_id_at_once(text: str) -> None:
    started_s = time.process_time()
    assert re.fullmatch(pattern(text), "A1" * 99 + "-!") is None
    assert time.process_time() - started_s < 1.0


def test_too_large_a_count_is_no_pattern() -> None:
    with pytest.raises(ValueError, match="is no pattern"):
        pattern("a{99999999999999}")
