"""A model that does worse than the one before it is told, one that does as well is not."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from cell.cli.cell_factory import Products
from cell.cli.run import another_model, changes
from cell.records.folder import Record
from cell.records.ledger.entry import entry_of_folder
from cell.records.ledger.ledger import Ledger
from cell.records.model_errors import worsenings
from cell.records.result import Outcome, Result
from cell.settings import load_settings
from cell.settings.promotion import promote, read_candidate
from cell.settings.provenance import line_name
from cell.settings.translate import model_hash

ROOT = Path(__file__).parents[3]


def cycles(model: str, count: int, error_m: float, seed: int) -> list[Result]:
    errors = error_m * np.random.default_rng(seed).normal(size=count)
    return [
        Result(
            cycle=i + 1,
            outcome=Outcome.INSERTED,
            folder=f"{model}{i}",
            predicted_miss_m=0.0,
            measured_miss_m=float(e),
            residual_rms_m=5e-5,
            noise_m=4e-5,
            model=model,
        )
        for i, e in enumerate(errors)
    ]


def test_a_model_that_forecasts_worse_is_told_within_a_few_cables() -> None:
    told = [
        worsenings([*cycles("a", 20, 1e-4, seed), *cycles("b", 20, 5e-4, 100 + seed)])
        for seed in range(20)
    ]
    assert sum(len(t) == 1 for t in told) >= 18
    text = str(next(t[0] for t in told if t))
    assert text.startswith("since the model was changed forecasts err by more: 0.")
    assert "mm rms in 20 cables, before 0." in text


def test_one_that_does_as_well_is_not_told_at_any_look() -> None:
    false = 0
    for seed in range(60):
        before, since = cycles("a", 20, 1e-4, seed), cycles("b", 20, 1e-4, 1000 + seed)
        false += any(worsenings([*before, *since[:n]]) for n in range(5, 21))
    assert false <= 3


@pytest.mark.parametrize("better", [4, 0])
def test_nothing_is_said_of_few_or_of_the_first_model(better: int) -> None:
    assert worsenings([*cycles("a", 20, 1e-4, 1)[:better], *cycles("b", 30, 5e-4, 2)]) == []


def promoted(tmp_path: Path, config: Path, effect: str) -> str:
    """Hash of the model of the settings, once a candidate with an effect has been promoted."""
    candidate = tmp_path / "candidate.yaml"
    candidate.write_text(
        f"format: cell-candidate/1\nbeside: {model_hash(load_settings(config).model)}\ngates: []\n"
        f"model: {{effects: [{{effect: {effect}}}]}}\n",
        "utf-8",
    )
    promote(read_candidate(candidate), config, from_another_line=True)
    return model_hash(load_settings(config).model)


def worse_line(tmp_path: Path, withdraw: bool) -> tuple[Path, str, str, Callable[[], list[str]]]:
    """Settings whose promoted model does worse, hashes of both, and what the end of a run says."""
    config = tmp_path / "cell.yaml"
    text = (ROOT / "config" / "fake.yaml").read_text(encoding="utf-8")
    config.write_text(f"{text}\npromotion: {{withdraw: {str(withdraw).lower()}}}\n", "utf-8")
    first = model_hash(load_settings(config).model)
    second = promoted(tmp_path, config, "air_drag")
    settings = load_settings(config)
    runs, found = tmp_path / "runs", []
    begun = datetime(2026, 11, 22)
    all_cycles = (*cycles(first, 20, 1e-4, 1), *cycles(second, 20, 8e-4, 2))
    for i, result in enumerate(all_cycles):
        record = Record(runs, result.cycle, begun + timedelta(seconds=i))
        found.append(result)
        record.close(result)
    line = line_name(settings)
    ledger = Ledger(runs, create=True)
    ledger.write([entry_of_folder(f, line) for f in sorted(runs.iterdir())], of_now=False)
    ledger.close()
    return config, first, second, lambda: changes(runs, found[-1:], config, Products(settings))


@pytest.mark.parametrize("withdraw", [False, True])
def test_the_line_goes_back_by_itself_only_if_the_settings_say_so(
    tmp_path: Path, withdraw: bool
) -> None:
    config, first, second, said = worse_line(tmp_path, withdraw)
    lines = said()
    assert any(line.startswith("since the model was changed forecasts err") for line in lines)
    if withdraw:
        assert model_hash(load_settings(config).model) == first
        assert lines[-1].startswith("withdrawn, as promotion.withdraw says")
    else:
        assert model_hash(load_settings(config).model) == second
        assert lines[-1].endswith(f"cell promote --undo --config {config}")


@pytest.mark.parametrize("withdraw", [False, True])
def test_a_model_promoted_meanwhile_is_not_taken_back_for_a_worse_one(
    tmp_path: Path, withdraw: bool
) -> None:
    """The run took it back, and gave the line the model that does worse again."""
    config, _, second, said = worse_line(tmp_path, withdraw)
    third = promoted(tmp_path, config, "tip_mass")
    lines = said()
    assert model_hash(load_settings(config).model) == third
    assert f"has the model {third} by now, not {second}" in lines[-1]
    assert "--undo" not in lines[-1]


def test_a_run_says_that_its_cycles_do_not_use_what_was_promoted_meanwhile(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    text = (ROOT / "config" / "fake.yaml").read_text(encoding="utf-8")
    config.write_text(text, "utf-8")
    begun = load_settings(config)
    assert another_model(config, begun) == ""
    config.write_text(f"# a word\n{text}", "utf-8")
    assert another_model(config, begun) == "", "the file changed, the model did not"
    config.write_text(f"{text}\nmodel: {{effects: [{{effect: air_drag}}]}}\n", "utf-8")
    said = another_model(config, begun)
    hashes = [model_hash(s.model) for s in (load_settings(config), begun)]
    assert (
        f"another model by now, {hashes[0]}: the cycles of this run still use {hashes[1]}" in said
    )
    config.write_text(f"{text}\nmodel: {{effects: [", "utf-8")
    assert another_model(config, begun) == "", "half edited: whoever reads it next complains"


def test_a_model_that_is_used_again_is_judged_by_its_cables_since_then() -> None:
    """It did worse when it was used first; its data were mended, and it was promoted again."""
    first = [*cycles("a", 20, 1e-4, 1), *cycles("b", 20, 5e-4, 2), *cycles("a", 20, 1e-4, 3)]
    assert worsenings(first) == []
    assert worsenings([*first, *cycles("b", 1, 1e-4, 4)]) == []
    (told,) = worsenings([*first, *cycles("b", 15, 6e-4, 5)])
    assert (told.cycles_before, told.cycles_since) == (20, 15)
