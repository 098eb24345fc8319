"""A motion that is designed for an effect shows it, whether or not the study has it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from cell.lab.next.effect_query import effect_queries
from cell.lab.next.linear_study import LinearStudy
from cell.lab.next.motion_file import Suggestion, hand_motion, write_motion
from cell.lab.next.simulated import with_motions
from cell.lab.next.study_power import forecast
from cell.lab.next.suggest import showing_motion, split_effects
from cell.lab.search.fit_cache import FitCache
from cell.settings.surroundings import Surroundings
from cell.study.folder import write_study
from tests.cell.lab.conftest import fits_of
from tests.command import run_cell

FAKE = Path(__file__).parents[4] / "config" / "fake.yaml"
NAMES = ("draught", "grip_angle", "tip_mass")
#: A few degrees of clamp angle: fewer strokes, as quick as it can be.
AROUND = Surroundings(angle_rad=(-0.1, 0.1))


@pytest.fixture(scope="module")
def fits(make_study) -> FitCache:
    return fits_of(make_study(seed=21), NAMES)


@pytest.fixture(scope="module")
def shown(fits: FitCache) -> Suggestion:
    (draught,), _ = effect_queries(["draught=0.03"], [])
    return showing_motion(fits, [draught], AROUND)


def test_the_model_without_the_effect_is_told_from_that_with_it(shown: Suggestion) -> None:
    assert shown.candidates == ("baseline", "draught (wind_x_m_per_s 0.03 m/s)")
    assert all(option.hardest == shown.candidates[1] for option in shown.options)
    apart = [option.separation for option in shown.options]
    assert apart == sorted(apart, reverse=True)
    assert apart[0] > 4.0 * apart[-1]


def test_a_study_with_the_best_motion_shows_more_than_with_the_worst(
    fits: FitCache, shown: Suggestion, tmp_path: Path
) -> None:
    """Forecast by another way: the whitened slopes of all trials, and the gates of a diagnosis."""
    (draught,), _ = effect_queries(["draught=0.015"], [])
    found = []
    for number in (0, -1):
        file = tmp_path / f"stroke{number % 2}.yaml"
        one = Suggestion(shown.candidates, (shown.options[number],), AROUND, {})
        write_motion(one, file)
        more = with_motions(fits, [hand_motion(file, (0.0, 0.0))])
        linear = LinearStudy.of(more.prepared, more.base.fit)
        found.append(forecast(more, draught, linear).noncentrality)
    assert found[0] > 1.2 * found[1]


def test_a_size_that_no_motion_shows_says_what_would_help(fits: FitCache) -> None:
    (faint,), _ = effect_queries(["tip_mass=1e-9"], [])
    with pytest.raises(ValueError, match=r"no safe motion tells baseline from tip_mass \("):
        showing_motion(fits, [faint], AROUND)


def test_names_are_shown_and_files_tried_but_not_both() -> None:
    assert split_effects(["air_drag", "my.py=0.1"]) == (["air_drag", "my.py=0.1"], [])
    assert split_effects(["my.py"]) == ([], ["my.py"])
    with pytest.raises(ValueError, match=r"my.py: is tried with the library, but air_drag asks"):
        split_effects(["my.py", "air_drag"])


def test_the_command_writes_the_motion_for_the_cell(fits: FitCache, tmp_path: Path) -> None:
    write_study(fits.prepared.study, tmp_path / "study")
    out = tmp_path / "motion.yaml"
    config, text = tmp_path / "cell.yaml", FAKE.read_text("utf-8")
    assert "angle_rad: [-0.6, 1.1]" in text
    config.write_text(text.replace("angle_rad: [-0.6, 1.1]", "angle_rad: [-0.1, 0.1]"), "utf-8")
    command = ["suggest", str(tmp_path / "study"), "--try", "draught", "-o", str(out)]
    command += ["--config", str(config)]
    done = run_cell(*command)
    assert yaml.safe_load(out.read_text())["purpose"].startswith("tell baseline from draught")
    assert "draught (wind_x_m_per_s" in done.stdout
