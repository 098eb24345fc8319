"""The lab on studies that MuJoCo made: no line of the project's own physics is in them."""

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.lab.diagnosis import diagnose
from tests.cell.lab.conftest import fits_of
from tools.worlds.made_studies import CABLE, STROKES

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("own_mesh")

RIVALS = (
    "tip_mass", "point_mass", "bending_hysteresis", "grip_compliance", "grip_angle",
    "natural_curvature", "linear_air_drag",
)  # fmt: skip


@pytest.fixture(scope="module")
def peer():
    from tools.worlds import mujoco_studies  # needs mujoco

    return mujoco_studies


@pytest.fixture
def explored(peer):
    def explore(**hidden):
        cable = peer.Specimen(hidden=peer.Hidden(**hidden))
        strokes = [s for s in STROKES if s.name in ("identify", "probe_up", "deep")]
        # twice the tables' step: it moves the markers by less than a thousandth of the noise
        study = peer.study_of(cable, seed=1, strokes=strokes, step_s=2.0 * peer.STEP_S)
        return diagnose(fits_of(study, RIVALS)).diagnosis

    return explore


def test_both_engines_move_the_same_cable_alike(peer):
    cable, stroke = peer.Specimen(), STROKES[0]
    t_s = np.arange(0.0, 1.0, 0.01)
    theirs = peer.true_markers(cable, stroke, t_s)
    log = np.arange(0.0, 1.1, 0.002)
    x, y = stroke.place_m(log).T
    model = CableModel(
        CABLE,
        cable.rigidity(np.linspace(0.0, 1.0, 15)),
        viscosity_n_m2_s=cable.viscosity_n_m2_s,
    )
    ours = simulate(model, Motion(log, x, y, 0 * log), t_s, peer.NODES_M)[0]
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 1e-5
    assert np.abs(theirs[:, 0] - theirs[0, 0]).max() > 0.05  # it does swing


def test_a_chain_without_anything_hidden_is_complete(explored):
    found = explored()
    assert found.verdict == "complete"
    assert found.baseline.heldout_rms_m == pytest.approx(1e-4, rel=0.04)


@pytest.mark.parametrize(
    ("effect", "hidden", "parameter", "true"),
    [
        ("tip_mass", 3e-5, "mass_kg", 3e-5),
        ("grip_compliance", 250.0, "rad_per_n_m", 250.0),
        ("bending_hysteresis", (4e-6, 1.2), "moment_n_m", 4e-6),
    ],
)
def test_what_is_hidden_in_a_chain_is_named_and_measured(explored, effect, hidden, parameter, true):
    found = explored(**{effect: hidden})
    assert found.verdict == "missing"
    assert [f.effect for f in found.missing] == [effect]
    value = found.missing[0].parameters[parameter]
    assert value.low < true < value.high
    assert value.value == pytest.approx(true, rel=0.12)
    assert found.missing[0].errors.heldout_rms_m < 1.04e-4


def test_a_mass_between_clamp_and_tip_is_named_with_its_place(explored):
    found = explored(point_mass=(1e-4, 0.515))
    assert found.verdict == "missing"
    assert [f.effect for f in found.missing] == ["point_mass"]
    mass, place = (found.missing[0].parameters[name] for name in ("mass_kg", "place"))
    assert mass.low < 1e-4 < mass.high
    assert place.value == pytest.approx(0.515, abs=0.05)
