"""A user's own checks and candidates are rows and effects like those of the lab."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cell.cable.effects import EffectError, library
from cell.lab.data.check import read_own_checks
from cell.lab.data.named_effects import candidates_in, select_effects
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.evidence import p_values
from cell.study.folder import write_study
from tests.command import run_cell

#: One marker errs more than the others: no effect explains that, and no check of the lab asks.
MARKERS = '''"""Is every marker as noisy as the others?"""

import numpy as np


def statistic(residuals):
    white = np.concatenate([r.white for r in residuals])
    return np.nanmean(white**2, axis=(0, 2)).max()
'''
FRAMES = '''"""Are neighbouring frames independent?"""

import numpy as np


def statistic(residuals):
    return np.mean([np.nanmean(r.white[1:] * r.white[:-1]) for r in residuals])
'''


@pytest.fixture
def checks(tmp_path: Path) -> list[Path]:
    for name, text in (("markers.py", MARKERS), ("frames.py", FRAMES)):
        (tmp_path / name).write_text(text)
    return [tmp_path / "markers.py", tmp_path / "frames.py"]


def test_of_a_complete_model_small_p_values_are_as_rare_as_they_should_be(
    make_study, checks: list[Path]
) -> None:
    asked = read_own_checks(checks)
    found = []
    for seed in range(12):
        fits = fit_cache_of(make_study(seed=300 + seed), select_effects([]))
        fit = fits.base.fit
        found += [p_values(fits.prepared, fit, [c], 1e-2)[c.name] for c in asked]
    p = np.array(found)
    assert np.mean(p < 0.05) <= 0.2  # of 24 with one in 20 more than 4 have a chance of 0.3 %
    assert 0.25 < np.mean(p) < 0.75
    assert np.mean(p < 0.5) < 0.8


def test_two_checks_are_corrected_for_being_two(make_study, checks: list[Path]) -> None:
    fits = fit_cache_of(make_study(seed=3), select_effects([]))
    asked, fit = read_own_checks(checks), fits.base.fit
    alone = [p_values(fits.prepared, fit, [c], 1e-2)[c.name] for c in asked]
    both = p_values(fits.prepared, fit, asked, 1e-2)
    assert min(both.values()) == pytest.approx(min(1.0, 2.0 * min(alone)), rel=0.5)


@pytest.mark.usefixtures("few_effects")
def test_what_only_a_user_asks_makes_a_study_unexplained(
    make_study, checks: list[Path], tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)

    def one_noisier(trial):
        xy_m = trial.markers.xy_m.copy()
        xy_m[:, 4] += rng.normal(0.0, 5e-5, xy_m[:, 4].shape)
        return xy_m

    write_study(make_study(seed=7).with_places(one_noisier), tmp_path / "study")
    verdicts = []
    for more in ([], ["--check", str(checks[0])]):
        out = tmp_path / "diagnosis.json"
        done = run_cell("diagnose", tmp_path / "study", "-o", out, *more)
        verdicts.append(json.loads(out.read_text()))
    assert [v["verdict"] for v in verdicts] == ["complete", "unexplained"]
    row = next(c for c in verdicts[1]["checks"] if c["name"] == "markers")
    assert row["passed"] is False
    assert row["statistic"] < 1e-3
    assert "Is every marker as noisy as the others?" in done.output


LAW = '''"""A law that a program wrote."""

from cell.cable.effects import Effect, Parameter


class {cls}(Effect):
    """F = −c v: drag."""

    name = "{name}"
    parameters = (Parameter("c", "N·s/m²", 0.0, 1.0, default=0.0, starts=(0.002,)),)

    def force(cable, at, p):
        {body}
        return -p.c * at.vx, -p.c * at.vy
'''


def test_candidates_of_a_folder_are_tried_and_the_others_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "laws"
    folder.mkdir()
    for name, body in (("drag", "pass"), ("endless", "while at.x < 9: pass"), ("bad", "open('x')")):
        text = LAW.format(cls=name.title(), name=name, body=body)
        (folder / f"{name}.py").write_text(text)
    (folder / "twin.py").write_text((folder / "drag.py").read_text())
    (folder / "broken.py").write_text("x = 1\n")
    (folder / "folder.py").mkdir()
    (folder / "gone.py").symlink_to("nowhere.py")
    good, refused = candidates_in(folder)
    assert good == [str(folder / "drag.py")]
    said = "\n".join(refused)
    assert len(refused) == 6
    assert "bad.py:13: `open` is not allowed" in said
    assert "broken.py:1: must define exactly one subclass of Effect" in said
    assert "folder.py:1: cannot be read: Is a directory" in said
    assert "gone.py:1: cannot be read: No such file or directory" in said
    assert "endless.force takes more than" in said
    assert f"twin.py: is called 'drag' as {folder / 'drag.py'} is; rename one" in said
    assert not Path("x").exists()
    assert "drag" not in library()
    with pytest.raises(ValueError, match="none: no such folder"):
        candidates_in(tmp_path / "none")
    with pytest.raises(ValueError, match=r"drag\.py: is a file; give a folder"):
        candidates_in(folder / "drag.py")
    with pytest.raises(ValueError, match="holds no effect"):
        candidates_in(folder / "folder.py")
    with pytest.raises(FileNotFoundError, match=r"folder\.py: is a folder, not an effect file"):
        select_effects([], [str(folder / "folder.py")])


def test_an_error_without_a_message_is_named_by_its_kind(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("raise MemoryError\n")
    with pytest.raises(EffectError, match=r"mine\.py:1: MemoryError: mend that"):
        select_effects([], [str(file)])
