"""Suggested motions: within the limits, and at the attitude that tells candidates apart."""

import numpy as np
import pytest
import yaml

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.bench import Bench
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.suggest import SafeLimits, read_limits, strokes, suggest_motion, write_motion
from cell.located import InputError


def test_strokes_keep_the_limits():
    limits = SafeLimits(angle_rad=(-1.1, 0.1), x_m=(-0.06, 0.1), velocity_m_per_s=0.3)
    offered = strokes(limits)
    assert offered
    for stroke in offered:
        motion = stroke.motion()
        step = np.diff(motion.t_s)
        speed = np.hypot(np.diff(motion.x_m), np.diff(motion.y_m)) / step
        assert speed.max() <= 0.3
        assert np.abs(np.diff(motion.y_m, 2)).max() / 0.002**2 <= 5.0
        assert motion.x_m.min() >= -0.06
        assert -1.1 <= stroke.angle_rad <= 0.1


def test_the_clamp_is_tilted_to_tell_added_mass_from_natural_curvature(make_study, tmp_path):
    known = library()
    level = make_study([known["added_mass"].active(kg_per_m=3e-4)], seed=3)
    level = type(level)(
        level.name, level.cable, level.arc_length_m,
        tuple(t for t in level.trials if t.name != "up"),
    )  # fmt: skip
    rivals = {n: known[n] for n in ("added_mass", "natural_curvature")}
    explorer = Explorer(Bench.of(level), ParameterSpace.of(level.cable), rivals)
    suggestion = suggest_motion(explorer, diagnose(explorer), SafeLimits())
    best = suggestion.options[0]
    level_best = max(o.separation for o in suggestion.options if o.motion.angle_rad == 0.0)
    assert abs(best.motion.angle_rad) > 0.4
    assert best.separation > 2.0 * level_best
    assert all(0.0 <= o.power <= 1.0 for o in suggestion.options)
    write_motion(suggestion, tmp_path / "motion.yaml")
    written = yaml.safe_load((tmp_path / "motion.yaml").read_text())
    assert written["start"]["angle_rad"] == best.motion.angle_rad


def test_limits_come_from_the_cell(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("limits:\n  x_m: [-0.1, 0.1]\n  y_m: [-0.2, 0.1]\n  velocity_m_per_s: 0.2\n")
    assert read_limits(path).velocity_m_per_s == 0.2
    path.write_text("cable: {}\n")
    with pytest.raises(InputError, match="limits"):
        read_limits(path)
