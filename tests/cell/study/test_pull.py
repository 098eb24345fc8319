"""Of a cable in a level plane the swing tells the stiffness; one that is held twice is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.api.lab import fit_study
from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.files.input_error import InputError
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import select_effects
from cell.lab.data.opened_study import open_study
from cell.lab.search.setup import fit_cache_of
from cell.study.data import Markers, Study, Trial
from cell.study.folder import read_study, write_study
from cell.study.plausible import impossible
from cell.study.pull import WEAK_M_PER_S2, pull_m_per_s2

LENGTH_M, FREQUENCY_HZ, DENSITY = 0.2, 4.0, 0.015
CABLE = Cable(LENGTH_M, DENSITY, 0.016, 3e-4)
#: Of a uniform clamped strip: ω² = 12.362 EI/(ρ L⁴).
RIGIDITY = DENSITY * (2 * np.pi * FREQUENCY_HZ) ** 2 * LENGTH_M**4 / 12.362
VISCOSITY = RIGIDITY * 0.03 / (np.pi * FREQUENCY_HZ)
ARCS = np.linspace(LENGTH_M, 0.1 * LENGTH_M, 6)


@pytest.fixture(scope="module")
def level() -> Study:
    """Swept sideways in a level plane, without gravity in it."""
    model = CableModel.uniform(CABLE, RIGIDITY, 1.0, VISCOSITY, (0.0, 0.0))
    rng, trials = np.random.default_rng(5), []
    for name, stroke in (("one", 0.06), ("two", -0.05)):
        t = np.arange(0.0, 2.4, 0.004)
        s = np.clip((t - 0.4) / 0.2, 0.0, 1.0)
        y = stroke * s**3 * (10 - 15 * s + 6 * s**2)
        grip = Motion(t, 0 * t, y, 0 * t)
        seen = t[::2]
        xy_m = simulate(model, grip, seen, ARCS, solver=Solver(segments=30))[0]
        xy_m = xy_m + rng.normal(0.0, 1e-4, xy_m.shape)
        trials.append(Trial(name, "fit", "equilibrium", grip, Markers(seen, xy_m)))
    return Study("level", CABLE, ARCS, tuple(trials), (0.0, 0.0))


def test_the_pull_is_that_under_which_the_cable_would_swing_as_it_does(level: Study) -> None:
    pull = pull_m_per_s2(level)
    assert pull is not None
    supposed = 0.4 * DENSITY * pull * LENGTH_M**3
    assert supposed == pytest.approx(RIGIDITY, rel=0.15)
    upright = replace(level, gravity_m_per_s2=(0.0, -9.81))
    assert pull_m_per_s2(upright) is None
    assert upright.scale_m_per_s2 == 9.81


def test_with_gravity_the_parameters_are_supposed_as_ever() -> None:
    plain = ParameterSpace.of(CABLE)
    assert plain.scale_m_per_s2 == 9.81
    same = ParameterSpace.of(CABLE, pull_m_per_s2=9.81)
    np.testing.assert_array_equal(plain.mean, same.mean)


def test_without_gravity_and_without_a_swing_nothing_tells_the_rigidity(
    level: Study, tmp_path: Path
) -> None:
    short = [
        replace(t, markers=Markers(t.markers.t_s[:76], t.markers.xy_m[:76])) for t in level.trials
    ]
    write_study(replace(level, trials=tuple(short)), tmp_path)
    with pytest.raises(InputError, match="record three swings after the motion"):
        open_study(tmp_path)


def test_a_level_cable_is_read_and_its_rigidity_and_viscosity_are_found(
    level: Study, tmp_path: Path
) -> None:
    write_study(level, tmp_path)
    opened = open_study(tmp_path)
    assert not opened.notes
    assert opened.gravity_m_per_s2 == (0.0, 0.0)
    model, _, _ = fit_study(fit_cache_of(opened, select_effects([])))
    low, high = model.interval()
    names = list(model.space.names)
    viscosity = names.index("viscosity")
    assert low[viscosity] < VISCOSITY < high[viscosity]
    middle = [names.index(f"rigidity_{i}") for i in range(4)]
    assert np.exp(np.mean(np.log(model.values[middle]))) == pytest.approx(RIGIDITY, rel=0.03)
    back = type(model).from_dict(model.to_dict())
    assert back.space.pull_m_per_s2 == opened.pull_m_per_s2
    assert isinstance(model.noise, Noise)


def test_a_weak_gravity_makes_no_record_too_short(level: Study, tmp_path: Path) -> None:
    """A droop of a tenth of a millimetre was once taken for a swing of eleven seconds."""
    weak = replace(level, gravity_m_per_s2=(0.0, -0.05))
    assert abs(weak.gravity_m_per_s2[1]) < WEAK_M_PER_S2
    write_study(weak, tmp_path)
    assert open_study(tmp_path).pull_m_per_s2 is not None


def test_both_ends_held_is_refused_in_one_sentence(level: Study, tmp_path: Path) -> None:
    trial = level.trials[0]
    share = ARCS / LENGTH_M
    hand = np.column_stack(
        [np.interp(trial.markers.t_s, trial.grip.t_s, v) for v in (trial.grip.x_m, trial.grip.y_m)]
    )
    # Bowed between the hand and a post at its other end, which stays.
    rest = np.stack([-0.9 * ARCS, 0.05 * LENGTH_M * np.sin(np.pi * share)], axis=1)
    xy_m = rest + hand[:, None] * (1.0 - share)[:, None]
    xy_m = xy_m + np.random.default_rng(1).normal(0.0, 1e-4, xy_m.shape)
    held = replace(trial, markers=Markers(trial.markers.t_s, xy_m))
    write_study(replace(level, trials=(held,)), tmp_path)
    with pytest.raises(InputError, match="both ends of this cable are held") as caught:
        read_study(tmp_path)
    assert len(str(caught.value).splitlines()) == 1
    xy_m[::2, 0] = xy_m[1::2, 1:] = np.nan  # by two cameras, one of which sees the tip alone
    still = replace(held, grip=Motion(trial.grip.t_s, *np.zeros((3, len(trial.grip.t_s)))))
    found = impossible(still, CABLE, ARCS, (0.0, 0.0))
    assert found is not None and "the cable between moves" in found.cause


def test_a_coordinate_that_is_not_seen_does_not_hold_the_tip(level: Study) -> None:
    """A laser sees the tip along the cable, the hand moves across it."""
    for trial in level.trials:
        along_m = trial.markers.xy_m.copy()
        along_m[..., 1] = np.nan
        seen = replace(trial, markers=Markers(trial.markers.t_s, along_m))
        assert impossible(seen, CABLE, ARCS, (0.0, 0.0)) is None


@pytest.mark.parametrize("gravity_m_per_s2", [(0.0, 0.0), (0.0, -0.05)])
@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_clocks_that_differ_are_seen_without_gravity(
    level: Study, gravity_m_per_s2: tuple[float, float], late_s: float
) -> None:
    """How long a cable may wait for its hand is as it swings, not as it would hang."""
    for trial in level.trials:
        markers = Markers(trial.markers.t_s + late_s, trial.markers.xy_m)
        found = impossible(replace(trial, markers=markers), CABLE, ARCS, gravity_m_per_s2)
        assert (found is None) == (late_s == 0.0)


def test_no_free_cable_is_taken_for_one_that_is_held_twice(level: Study) -> None:
    for trial in level.trials:
        assert impossible(trial, CABLE, ARCS, (0.0, 0.0)) is None


def test_a_record_that_ends_before_the_hand_moves_says_nothing_of_the_tip(level: Study) -> None:
    """It was once refused as one of a cable whose both ends are held."""
    trial = level.trials[0]
    early = trial.markers.t_s < 0.42  # the hand moves from 0.4 to 0.6 s
    short = replace(trial, markers=Markers(trial.markers.t_s[early], trial.markers.xy_m[early]))
    assert impossible(short, CABLE, ARCS, (0.0, 0.0)) is None


def test_a_tip_that_is_lost_before_the_hand_moves_says_nothing(level: Study) -> None:
    """Rows without the tip were once counted as rows in which it stayed."""
    trial = level.trials[0]
    for lost in (slice(None), slice(0, 1)):  # all markers; the tip's alone, the others go on
        xy_m = trial.markers.xy_m.copy()
        xy_m[trial.markers.t_s > 0.42, lost] = np.nan
        early = replace(trial, markers=Markers(trial.markers.t_s, xy_m))
        assert impossible(early, CABLE, ARCS, (0.0, 0.0)) is None, lost
