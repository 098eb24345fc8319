"""Limits of effects that a study does not show: at the true edge, and silent where it is blind."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.lab.data.prepared import PreparedStudy, all_fitted, as_measured, with_noise_model
from cell.lab.data.results import to_json
from cell.lab.diagnosis import diagnose, with_limits
from cell.lab.fit.fitting import extended, fit_model, space_with
from cell.lab.fit.systematic_error import AllTrialsFit
from cell.lab.report.tables import limits_table
from cell.lab.strength.limits import LimitSearch, limits
from cell.study.data import Markers
from tests.cell.lab.conftest import LONG, STROKES, fits_of
from tools.worlds import made_studies

KNOWN = library()


def baseline(study):
    fits = fits_of(all_fitted(study))
    return fits.prepared, fits.base.fit


@pytest.fixture(scope="module")
def fitted(make_study):
    return baseline(make_study([], seed=21, strokes=STROKES, hold_s=0.8))


def _at_rest(trial):
    """What was seen before the gripper moved."""
    still = slice(0, int(np.searchsorted(trial.markers.t_s, 0.2)))
    seen = Markers(trial.markers.t_s[still], trial.markers.xy_m[still])
    return replace(trial, markers=seen)


def misfit(prepared, fit, effect, value=None):
    """χ² with an effect of the shape guessed, everything else fitted anew; its amplitude held."""
    space = space_with(fit.space, (effect,))
    others = [p.default for p in effect.parameters[1:]]
    first = effect.parameters[0].default if value is None else value
    q = extended(fit, space, effect, np.array([first, *others]))
    for p in effect.parameters:
        if not p.amplitude or value is not None:
            i = space.names.index(f"{effect.name}.{p.name}")
            space.low[i] = space.high[i] = q[i]
    return fit_model(prepared, space, q).objective


@pytest.mark.parametrize("name", ["tip_mass", "camera_scale", "grip_compliance"])
def test_at_its_limit_an_effect_costs_what_excludes_it(fitted, name):
    """The misfit with the effect held there, everything else fitted anew, is that of 95 %.

    On a finer mesh than the limit was computed with: what the mesh errs by is taken off.
    """
    prepared, fit = fitted
    effect = KNOWN[name]
    (found,) = limits(AllTrialsFit(prepared, fit), [effect])
    finer = PreparedStudy.of(as_measured(prepared), solver=Solver(segments=64, step_s=5e-4))
    prepared = with_noise_model(finer, prepared.noise_model)
    rise = misfit(prepared, fit, effect, found.high) - misfit(prepared, fit, effect)
    reach = 1.960 if name == "camera_scale" else 1.645
    assert np.sqrt(rise) == pytest.approx(reach, rel=0.15)


def test_a_limit_is_of_one_sign_where_the_effect_is(fitted):
    prepared, fit = fitted
    drag, roll = limits(AllTrialsFit(prepared, fit), [KNOWN["air_drag"], KNOWN["camera_roll"]])
    assert (drag.low, drag.unit) == (0.0, "1")
    assert 0.0 < drag.high < 2.0
    assert roll.low < roll.high
    assert 1e-6 < drag.tip_m < 5e-3
    assert 1e-6 < roll.tip_m < 5e-3


def test_of_two_amplitudes_each_has_its_own_limit(fitted):
    found = limits(AllTrialsFit(*fitted), [KNOWN["natural_curvature"]])
    assert [f.parameter for f in found] == ["curvature_1_per_m", "gradient_1_per_m2"]


def test_what_softer_bending_near_the_clamp_imitates_is_not_excluded(make_study, fitted):
    """EI(s) was fitted without the jaws' compliance and has taken it up."""
    effect = KNOWN["grip_compliance"]
    (limit,) = limits(AllTrialsFit(*fitted), [effect])
    true = 2.0 * limit.high
    study = make_study([effect.active(rad_per_n_m=true)], seed=22)
    (found,) = limits(AllTrialsFit(*baseline(study)), [effect])
    assert true < found.high < 3.0 * true + limit.high


def test_limits_hold_for_every_shape_that_fits_as_well(make_study):
    """A ringing that soon dies away must be stronger than one that lasts to be seen as well."""
    ringing = KNOWN["robot_ringing"].active(amplitude_m=6e-5, frequency_hz=12.0, damping=0.05)
    (found,) = limits(AllTrialsFit(*baseline(make_study([ringing], seed=21))), [ringing.effect])
    assert found.low < 6e-5 < found.high


def test_what_nothing_shows_is_not_excluded(make_study):
    """In a cable that hangs still no picture tells when it was taken."""
    study = make_study([], seed=21)
    still = [_at_rest(t) for t in study.trials[:1]]
    prepared, fit = baseline(replace(study, trials=tuple(still)))
    latency, angle = limits(
        AllTrialsFit(prepared, fit), [KNOWN["camera_latency"], KNOWN["grip_slip"]]
    )
    assert (latency.low, latency.high, latency.tip_m) == (None, None, None)
    assert angle.high is not None


def test_a_strong_effect_that_bends_what_the_others_do_does_not_lower_its_limit():
    """Held where slopes say, such a grip seems excluded far below; from there, far above.

    The limit ended at one of both in turns: here at 2.7 rad/(N·m) for a grip that gives 46.
    """
    grip = KNOWN["grip_compliance"]
    study = made_studies.make_study(1522, [grip.active(rad_per_n_m=46.0)], noise_seed=301522)
    (found,) = limits(AllTrialsFit(*baseline(study)), [grip])
    assert 46.0 < found.high < 80.0


def test_where_trials_disagree_on_an_effect_its_limits_are_wider(make_study):
    """One of five is turned by 1 mrad: as much as all of them might be."""
    study = make_study([], seed=21, **LONG)
    turned = study.trials[3]
    c, s = np.cos(1e-3), np.sin(1e-3)
    xy_m = turned.markers.xy_m @ np.array([[c, s], [-s, c]])
    turned = replace(turned, name="turned", markers=Markers(turned.markers.t_s, xy_m))
    prepared, fit = baseline(replace(study, trials=(*study.trials, turned)))
    (roll,) = limits(AllTrialsFit(prepared, fit), [KNOWN["camera_roll"]])
    assert roll.low < 0.0 < roll.high


def test_a_diagnosis_tells_them_for_what_is_neither_named_nor_tied(make_study):
    study = make_study([KNOWN["tip_mass"].active(mass_kg=3e-5)], seed=8)
    examination = with_limits(diagnose(fits_of(study, ["tip_mass", "air_drag", "camera_scale"])))
    found = examination.diagnosis
    assert [f.effect for f in found.missing] == ["tip_mass"]
    assert [limit.effect for limit in found.limits] == ["air_drag", "camera_scale"]
    drag, scale = found.limits
    assert 0.0 < drag.high < 1.0
    assert scale.low < 1.0 < scale.high
    written = json.loads(json.dumps(to_json(found), allow_nan=False))
    assert written["limits"][0]["high"] == drag.high
    unseen = replace(found, limits=(replace(drag, low=None, high=None, tip_m=None),))
    assert limits_table(unseen).rows == [
        ["air_drag", "drag_coefficient", "this study could not have shown it", ""],
    ]


@pytest.mark.parametrize(("seen", "end"), [((7.3, 8.0), 8.945 / 0.8), ((0.5, 4.0), 5.645 / 3.0)])
def test_of_a_strong_effect_no_shape_is_dropped_for_what_slopes_promise(seen, end):
    """A grip that gave 17 rad/(N·m) was limited to 3.3: its pads' time was dropped.

    By slopes at a rigid grip a time three times as long explained 64, the true one 53 of 134.
    """
    slopes = SimpleNamespace(
        effect=KNOWN["grip_compliance"],
        rows=np.array([[[0.8, 0.0, 0.0]], [[0.0, 3.0, 0.0]]]),
        values=np.array([[5.0, 0.01], [5.0, 0.03]]),
    )
    nuisance = SimpleNamespace(remove=lambda rows: rows, residual=np.array([*seen, 0.0]))
    wrong = SimpleNamespace(variance=lambda left: 0.0, by_trial=lambda rows: [rows])
    (side,) = LimitSearch(slopes, 0, nuisance, wrong, 1.0).open_sides()
    assert side.size == pytest.approx(end, rel=1e-3)
