"""Discovered laws as files: readable, loadable, and started where they were found."""

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import load_effect
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.lab.terms import admissible, effect_source

BOX = (-0.1, 0.0, -0.09, 0.0)
TERMS = {t.name: t for t in admissible(BOX)}


@pytest.mark.parametrize("name", ["constant_field", "point", "dry_bending"])
def test_every_kind_of_term_becomes_an_effect_that_acts(name, tmp_path, make_study):
    term = TERMS[name]
    path = tmp_path / f"{name}_{tmp_path.name}.py"
    path.write_text(effect_source(name, [term], "A law."), encoding="utf-8")
    effect = load_effect(path)
    assert [p.name for p in effect.parameters] == [n.name for n in term.numbers]
    cable = make_study().cable
    t = np.linspace(0.0, 0.3, 151)
    motion = Motion(t, 0 * t, -0.05 * np.clip(t / 0.1, 0, 1), 0 * t)
    tip = np.array([0.1])
    strong = {n.name: n.starts[0] for n in term.numbers if n.amplitude}
    off, on = (
        simulate(CableModel.uniform(cable, 2.5e-5, 1.0, 1e-7, effects=(e,)), motion, t, tip)[0]
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
