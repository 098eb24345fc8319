"""Discovered laws as files: readable, loadable, and started where they were found."""

from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library, load_effect, unscreened
from cell.cable.effects.base import Bend, CableData, Effect, Place
from cell.cable.effects.check import check
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.lab.next import discover
from cell.lab.next.discover import effect_source
from cell.lab.next.terms import NAMESPACE, admissible
from tests.cell.lab.conftest import CABLE as STRIP

BOX = (-0.1, 0.0, -0.09, 0.0)
TERMS = {t.name: t for t in admissible(BOX)}


def test_no_term_has_the_name_of_an_effect_of_the_library():
    """A term was called `power_drag`, a library effect too later: no study had a law any more."""
    ours = {*library(), *unscreened()}
    assert not any(name.startswith(NAMESPACE) for name in ours)
    assert all(term.effect.startswith(NAMESPACE) for term in TERMS.values())
    assert len(TERMS) == len(admissible(BOX))


def test_terms_that_become_one_effect_share_no_parameter():
    names = [n.name for term in TERMS.values() for n in term.numbers]
    assert len(names) == len(set(names))


def test_laws_of_a_folder_go_by_their_names_and_old_files_are_kept(
    tmp_path, make_study, monkeypatch
):
    """Files were taken by their own names, so that a renamed law hid another."""
    few = [TERMS["constant_field"], TERMS["drag_along"]]
    monkeypatch.setattr(discover, "admissible", lambda _: few)
    mine = effect_source("drag_along", [TERMS["drag_along"]], "A law.")
    (tmp_path / "mine.py").write_text(mine, encoding="utf-8")
    study = make_study()
    laws = discover.laws_in(tmp_path, [study])
    assert set(laws.effects) == {"drag_along", "law_constant_field"}
    assert [p.name for p in laws.written] == ["law_constant_field.py"]
    again = discover.laws_in(tmp_path, [study], [laws.effects["drag_along"]])
    assert (set(again.effects), again.written) == ({"law_constant_field"}, ())
    (tmp_path / "twice.py").write_text(mine, encoding="utf-8")
    with pytest.raises(ValueError, match=r"twice.py: is called 'drag_along' as mine.py is"):
        discover.laws_in(tmp_path, [study])


@pytest.mark.parametrize("name", ["constant_field", "point", "dry_bending"])
def test_every_kind_of_term_becomes_an_effect_that_acts(name, tmp_path):
    term = TERMS[name]
    path = tmp_path / f"{name}_{tmp_path.name}.py"
    path.write_text(effect_source(name, [term], "A law."), encoding="utf-8")
    effect = load_effect(path)
    assert [p.name for p in effect.parameters] == [n.name for n in term.numbers]
    t = np.linspace(0.0, 0.3, 151)
    motion = Motion(t, 0 * t, -0.05 * np.clip(t / 0.1, 0, 1), 0 * t)
    tip = np.array([0.1])
    strong = {n.name: n.starts[0] for n in term.numbers if n.amplitude}
    off, on = (
        simulate(CableModel.uniform(STRIP, 2.5e-5, 1.0, 1e-7, effects=(e,)), motion, t, tip)[0]
        for e in (effect.active(), effect.active(**strong))
    )
    assert np.abs(on - off).max() > 1e-5


def test_found_values_become_starts_and_defaults():
    source = effect_source("found", [TERMS["point"]], "A law.", {"pull": 0.02, "core_m": 0.03})
    space: dict[str, object] = {}
    exec(compile(source, "found.py", "exec"), space)
    known = {p.name: p for p in space["Found"].parameters}
    assert known["pull"].default == 0.0
    assert known["pull"].starts == (0.02,)
    assert known["core_m"].default == 0.03


def test_laws_together_are_dissipative_only_if_all_are():
    both = effect_source("x", [TERMS["drag_along"], TERMS["constant_field"]], "A law.")
    assert "dissipative = False" in both
    assert "dissipative = True" in effect_source("x", [TERMS["drag_along"]], "A law.")


CABLE = CableData(0.016, 1e-4, 0.0074, 0.1)


def as_effect(name: str) -> type[Effect]:
    """The term in plain Python, not compiled."""
    space: dict[str, type[Effect]] = {}
    exec(compile(effect_source(name, [TERMS[name]], "A law."), f"{name}.py", "exec"), space)
    return space["".join(part.title() for part in name.split("_"))]


def acting(name: str, at: Place | Bend, **values: float) -> np.ndarray:
    """Force per metre or moment of a term at a place, its other parameters at their defaults."""
    effect = as_effect(name)
    p = SimpleNamespace(**{q.name: q.default for q in effect.parameters} | values)
    if isinstance(at, Bend):
        return np.array(effect.moment(CABLE, at, None, p))
    return np.array(effect.force(CABLE, at, p))


def moving(vx: float, vy: float, angle: float = 0.4) -> Place:
    tx, ty = -np.cos(angle), -np.sin(angle)
    return Place(-0.03, -0.06, vx, vy, tx, ty, angle, 3.0, 0.04, 0.0)


@pytest.mark.parametrize("name", TERMS)
def test_every_term_is_physical_and_off_without_its_amplitudes(name):
    check(as_effect(name))


@pytest.mark.parametrize("n", [0.5, 1.5, 3.0])
def test_powers_are_those_of_speed_and_rate(n):
    for factor in (0.3, 2.0):
        once = acting("power_drag", moving(0.2, -0.4), power_drag=0.01, drag_exponent=n)
        more = acting(
            "power_drag", moving(0.2 * factor, -0.4 * factor), power_drag=0.01, drag_exponent=n
        )
        assert more == pytest.approx(factor**n * once, rel=1e-3)
        moments = [
            acting("power_viscosity", Bend(2.0, rate, 3e-5, 0.02), power_viscosity=1e-6,
                   rate_exponent=n)
            for rate in (30.0, 30.0 * factor)
        ]  # fmt: skip
        assert moments[0] == pytest.approx(1e-6, rel=1e-3)
        assert moments[1] == pytest.approx(1e-6 * factor**n, rel=1e-3)


def test_lifts_do_no_work_or_push_to_one_side_alone():
    at = moving(0.3, -0.5)
    fx, fy = acting("lift_across_path", at, path_lift=0.01)
    assert fx * at.vx + fy * at.vy == pytest.approx(0.0, abs=1e-15)
    assert np.hypot(fx, fy) == pytest.approx(0.01 * (0.34 / 0.25), rel=1e-3)
    fx, fy = acting("lift_across_cable", at, side_lift=0.01)
    assert fx * at.tx + fy * at.ty == pytest.approx(0.0, abs=1e-15)
    back = acting("lift_across_cable", moving(-0.3, 0.5), side_lift=0.01)
    assert back == pytest.approx(np.array([fx, fy]))


def test_cable_that_moves_with_the_sheared_wind_feels_none():
    wind = {"wind_drag": 0.02, "wind_x": 0.2, "wind_y": -0.1, "shear_xy": 3.0, "shear_yx": -2.0}
    at = moving(0.2 + 3.0 * (-0.06 + 0.045), -0.1 - 2.0 * (-0.03 + 0.05))
    assert acting("sheared_wind", at, **wind) == pytest.approx(np.zeros(2), abs=1e-12)
    assert np.abs(acting("sheared_wind", moving(0.0, 0.0), **wind)).max() > 1e-5


def test_stiffness_that_changes_reaches_a_level_or_grows_with_the_square():
    def share(curvature: float, levels: float) -> float:
        at = Bend(curvature, 0.0, 3e-5, 0.02)
        moment = acting("curved_stiffness", at, stiffer=0.1, levels=levels)
        return float(moment) / (3e-5 * curvature)

    assert share(10.0, 0.0) == share(-10.0, 0.0) == pytest.approx(0.1)
    assert share(20.0, 0.0) == pytest.approx(0.4)
    assert share(10.0, 0.5) == pytest.approx(0.1)
    assert share(100.0, 0.5) == pytest.approx(0.102, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "centre"), [("point", "pull_centre"), ("spring", "spring_centre")]
)
def test_a_force_that_all_of_the_cable_feels_alike_is_inside_the_bounds(name, centre):
    """It was at a bound, and a gate refused a magnet that pulls at every place alike."""
    (known,) = [n for n in TERMS[name].numbers if n.name == centre]
    assert known.low < 0.45 and known.high > 0.55
    amplitude = {"point": {"pull": 1.0}, "spring": {"spring_x": 1.0}}[name]
    places_m = (np.arange(400) + 0.5) / 400 * CABLE.free_length_m

    def along(share: float) -> np.ndarray:
        still = (-0.03, -0.06, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0)
        fx = [
            acting(name, Place(*still, s, 0.0), **{centre: share}, **amplitude)[0] for s in places_m
        ]
        return np.array(fx)

    alike = along(0.5)
    np.testing.assert_allclose(alike, alike[0])
    for share in (0.4, 0.75, 0.95):
        weight = along(share) / alike
        assert np.mean(weight) == pytest.approx(1.0, rel=0.04)  # rounded near the jaw
        assert np.mean(weight * places_m) / CABLE.free_length_m == pytest.approx(share, rel=0.04)
