"""A model enters the settings and leaves them again, and nothing else in the file changes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from difflib import ndiff
from pathlib import Path

import pytest

from cell.files import atomic
from cell.files.input_error import InputError
from cell.files.overwriting import check_output
from cell.files.yaml_document import yaml_text
from cell.settings import load_settings
from cell.settings.loading import for_product, load_product
from cell.settings.promotion import (
    ChangedMeanwhileError,
    differences,
    history_of,
    line_identity,
    other_lines,
    promote,
    read_candidate,
    replace_settings,
    spliced,
    undo,
    versions,
)
from cell.settings.translate import model_hash

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
DRAG = {"effects": [{"effect": "air_drag", "parameters": {"drag_coefficient": {"fixed": 1.9}}}]}


def candidate(
    tmp_path: Path,
    config: Path,
    model: dict = DRAG,
    *,
    passed: bool = True,
    product: str | None = None,
) -> Path:
    settings = load_product(config, product)
    path = tmp_path / f"{product or 'candidate'}.yaml"
    content = {
        "format": "cell-candidate/1",
        "product": product,
        "beside": model_hash(settings.model),
        "model": model,
        "gates": [{"gate": "forecasts unseen cables better", "passed": passed, "found": "so"}],
        "lines": [line_identity(settings)],
    }
    path.write_text(yaml_text(content), encoding="utf-8")
    return path


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return Path(shutil.copy(CONFIG, tmp_path / "cell.yaml"))


def test_all_other_lines_stay_as_they_were(tmp_path: Path, config: Path) -> None:
    before = config.read_bytes()
    entry = promote(read_candidate(candidate(tmp_path, config)), config)
    after = config.read_bytes()
    assert after.startswith(before)
    assert load_settings(config).model.effects[0].effect == "air_drag"
    assert entry.read_bytes() == before
    undo(config)
    assert config.read_bytes() == before


def test_a_second_promotion_replaces_the_first_between_its_neighbours(
    tmp_path: Path, config: Path
) -> None:
    text = config.read_text(encoding="utf-8")
    section = "model:              # learned in May\n  effects:\n  - effect: tip_mass  # glue\n\n"
    config.write_text(text.replace("limits:", f"{section}# the box\nlimits:"), encoding="utf-8")
    before = config.read_text(encoding="utf-8")
    promote(read_candidate(candidate(tmp_path, config)), config)
    after = config.read_text(encoding="utf-8")
    assert "# the box\nlimits:" in after and "tip_mass" not in after
    head, tail = before.split(section.rstrip("\n"))
    assert after.startswith(head) and after.endswith(tail)
    # what a person changes meanwhile survives going back
    config.write_text(after.replace("lag_s: 0.03", "lag_s: 0.031  # measured"), encoding="utf-8")
    undo(config)
    assert config.read_text("utf-8") == before.replace("lag_s: 0.03", "lag_s: 0.031  # measured")
    with pytest.raises(InputError, match=r":1: nothing to undo: no model"):
        undo(config)


def test_line_ends_are_kept(tmp_path: Path, config: Path) -> None:
    config.write_bytes(config.read_bytes().replace(b"\n", b"\r\n"))
    promote(read_candidate(candidate(tmp_path, config)), config)
    after = config.read_bytes()
    assert after.count(b"\n") == after.count(b"\r\n")
    assert load_settings(config).model.effects


def test_what_failed_a_gate_or_was_learned_beside_another_model_is_refused(
    tmp_path: Path, config: Path
) -> None:
    before = config.read_bytes()
    failed = read_candidate(candidate(tmp_path, config, passed=False))
    with pytest.raises(InputError, match=r"'forecasts unseen cables better': not passed"):
        promote(failed, config)
    good = read_candidate(candidate(tmp_path, config))
    promote(good, config)
    with pytest.raises(InputError, match="was learned with the model"):
        promote(good, config)
    undo(config)
    assert config.read_bytes() == before


def test_what_was_learned_on_another_line_is_refused_unless_it_is_meant(
    tmp_path: Path, config: Path
) -> None:
    """A tip mass of one line went into the settings of another, with a draught, without a word."""
    before = config.read_text("utf-8")
    chosen = read_candidate(candidate(tmp_path, config))
    assert chosen.lines == (line_identity(load_settings(config)),), "as it was before it was a file"
    for old, new, says in (
        ("width_m: 0.016", "width_m: 0.018", "cable.width_m 0.016, here 0.018"),
        ("lag_s: 0.03", "lag_s: 0.04", "calibration.typed.lag_s 0.03, here 0.04"),
        ("ratio: [0.02,", "ratio: [0.03,", "world.damping_ratio [0.02, 0.06], here [0.03, 0.06]"),
    ):
        assert old in before, old
        config.write_text(before.replace(old, new), "utf-8")
        with pytest.raises(InputError, match="was learned on another line") as refused:
            promote(chosen, config)
        assert says in str(refused.value)
        assert "--from-another-line" in str(refused.value)
    promote(chosen, config, from_another_line=True)
    assert load_settings(config).model.effects[0].effect == "air_drag"
    config.write_text(before, "utf-8")
    with pytest.raises(InputError, match="nothing says on which line it was learned"):
        promote(replace(chosen, lines=()), config)
    promote(chosen, config)


def test_how_finely_a_world_is_simulated_makes_no_other_line(config: Path) -> None:
    settings = load_settings(config)
    finer = settings.model_copy(
        update={"world": settings.world.model_copy(update={"segments": 100})}
    )
    assert differences(line_identity(settings), line_identity(finer)) == []
    assert other_lines([line_identity(finer)], settings) == []
    heated = settings.model_copy(
        update={"world": settings.world.model_copy(update={"effects": {"draught": {"x": 1.0}}})}
    )
    (said,) = other_lines([line_identity(finer), line_identity(heated)], settings)
    assert said == "cycles of another line are among these: world.effects.draught.x 1.0, here None"


def test_a_gate_without_its_outcome_is_refused(tmp_path: Path, config: Path) -> None:
    path = candidate(tmp_path, config)
    path.write_text(path.read_text().replace("passed: true", "assed: true"))
    with pytest.raises(InputError, match="needs gate, passed and found; learn it again"):
        read_candidate(path)


def test_a_former_model_that_cannot_be_used_any_more_is_not_written(
    tmp_path: Path, config: Path
) -> None:
    """Its effect was removed meanwhile: the settings were wrong, and no cell began with them."""
    entry = promote(read_candidate(candidate(tmp_path, config)), config)
    former, promoted = entry.read_text("utf-8"), config.read_bytes()
    entry.write_text(f"{former}\nmodel:\n  effects: [{{effect: removed}}]\n", "utf-8")
    with pytest.raises(InputError, match="'removed': unknown effect"):
        undo(config)
    assert config.read_bytes() == promoted and entry.exists()


def test_a_model_is_taken_back_only_for_the_one_that_is_meant(tmp_path: Path, config: Path) -> None:
    first = model_hash(load_settings(config).model)
    promote(read_candidate(candidate(tmp_path, config)), config)
    second, promoted = model_hash(load_settings(config).model), config.read_bytes()
    with pytest.raises(InputError, match=f"has the model {second} by now, not {first}"):
        undo(config, meant=(first, second))
    with pytest.raises(InputError, match=f"would restore the model {first}, not 0123"):
        undo(config, meant=(second, "0123"))
    assert config.read_bytes() == promoted
    undo(config, meant=(second, first))
    assert model_hash(load_settings(config).model) == first


def test_a_wrong_model_is_not_written(tmp_path: Path, config: Path) -> None:
    before = config.read_bytes()
    wrong = {"effects": [{"effect": "air_drag", "parameters": {"drag_coefficient": {"fixed": -1}}}]}
    with pytest.raises(InputError, match="must be 0"):
        promote(read_candidate(candidate(tmp_path, config, wrong)), config)
    assert config.read_bytes() == before
    assert not history_of(config).exists()


@pytest.mark.parametrize("survives", range(5))
def test_killed_between_any_two_writes_the_settings_are_old_or_new(
    tmp_path: Path, config: Path, monkeypatch: pytest.MonkeyPatch, survives: int
) -> None:
    old = config.read_bytes()
    chosen = read_candidate(candidate(tmp_path, config))
    writes = 0

    class KilledError(BaseException):
        pass

    def counted(real):
        def write(self: Path, *args):
            nonlocal writes
            if writes == survives:
                raise KilledError
            writes += 1
            return real(self, *args)

        return write

    for name in ("write_bytes", "replace", "rename"):
        monkeypatch.setattr(atomic.Path, name, counted(getattr(Path, name)))
    try:
        promote(chosen, config)
        undo(config)
    except KilledError:
        pass
    monkeypatch.undo()
    found = config.read_bytes()
    assert found == old or load_settings(config).model.effects[0].effect == "air_drag"
    assert load_settings(config)
    if load_settings(config).model.effects:
        undo(config)
    assert config.read_bytes().rstrip() == old.rstrip()


def test_a_file_in_braces_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not one key a line"):
        spliced(tmp_path / "x.yaml", "{cable: 1}\n", "model: {}\n")


def test_a_candidate_may_be_learned_again_over_the_one_before(tmp_path: Path, config: Path) -> None:
    check_output(candidate(tmp_path, config))
    with pytest.raises(ValueError, match="was not written by this program"):
        check_output(config)


PRODUCTS = """
products:
  soft:                # the usual one
    part_ids: 'S-.*'
  stiff:
    cable: {free_length_m: 0.09}   # shorter
    model:             # learned in May
      effects:
      - effect: tip_mass
  # the last one
  empty:
"""


@pytest.fixture
def with_products(config: Path) -> Path:
    text = config.read_text(encoding="utf-8") + PRODUCTS.replace("  empty:\n", "  empty: {}\n")
    config.write_text(text, encoding="utf-8")
    return config


#: What is replaced in its section.
OF_STIFF = {"    model:             # learned in May", "      - effect: tip_mass"}


@pytest.mark.parametrize("product", ["soft", "stiff"])
def test_a_promotion_touches_one_product_and_can_be_undone(
    tmp_path: Path, with_products: Path, product: str
) -> None:
    before, text = load_settings(with_products), with_products.read_text("utf-8")
    entry = promote(
        read_candidate(candidate(tmp_path, with_products, product=product)), with_products
    )
    after = load_settings(with_products)
    made = for_product(after, product)
    assert [e.effect for e in made.model.effects] == ["air_drag"]
    assert after.model == before.model
    others = set(after.products) - {product}
    assert all(after.products[name] == before.products[name] for name in others)
    lines = ndiff(text.splitlines(), with_products.read_text("utf-8").splitlines())
    gone = {line[2:] for line in lines if line.startswith("- ")}
    assert gone == (OF_STIFF if product == "stiff" else set())
    assert entry.read_text("utf-8") == text
    undo(with_products, product)
    assert with_products.read_text("utf-8") == text


def test_undoing_one_product_leaves_what_was_promoted_for_another(
    tmp_path: Path, with_products: Path
) -> None:
    for product in ("soft", "stiff"):
        promote(read_candidate(candidate(tmp_path, with_products, product=product)), with_products)
    undo(with_products, "soft")
    settings = load_settings(with_products)
    assert for_product(settings, "soft").model == settings.model
    assert for_product(settings, "stiff").model.effects[0].effect == "air_drag"
    with pytest.raises(InputError, match=r":1: nothing to undo: no model"):
        undo(with_products, "soft")


def test_a_candidate_is_of_a_product_of_these_settings(tmp_path: Path, with_products: Path) -> None:
    text = with_products.read_text("utf-8")
    stiff = read_candidate(candidate(tmp_path, with_products, product="stiff"))
    for other, says in (
        (replace(stiff, product=None), "is missing, but the settings have products"),
        (replace(stiff, product="short"), "'short' is no product of these settings"),
        (replace(stiff, product="soft"), "was learned on another line: cable.free_length_m 0.09"),
    ):
        with pytest.raises(InputError, match=says):
            promote(other, with_products)
    empty = read_candidate(candidate(tmp_path, with_products, product="empty"))
    with pytest.raises(InputError, match="is not one key a line in this section"):
        promote(empty, with_products)
    assert with_products.read_text("utf-8") == text


def test_the_former_file_is_kept(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    config.write_bytes(b"a: 1\r\n")
    link = tmp_path / "link.yaml"
    link.symlink_to(config)
    assert replace_settings(link, "a: 1\r\n", "a: 2\n").read_bytes() == b"a: 1\r\n"
    replace_settings(config, "a: 2\n", "a: 3\n")
    assert link.is_symlink() and config.read_text("utf-8") == "a: 3\n"
    assert [p.read_bytes() for p in versions(link)] == [b"a: 2\n", b"a: 1\r\n"]


def test_a_file_that_was_changed_meanwhile_stays(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    config.write_text("a: 7\n", "utf-8")
    with pytest.raises(ChangedMeanwhileError) as refused:
        replace_settings(config, "a: 1\n", "a: 2\n")
    assert refused.value.text == config.read_text("utf-8") == "a: 7\n"
    assert versions(config) == ()
