import json

import numpy as np
import pytest

from cell.exchange.description import description


def test_a_reader_can_compute_the_moment_from_it_alone(flat_model):
    model = flat_model(2, 0.93, air_drag={"drag_coefficient": 2.0})
    data = json.loads(json.dumps(description(model), allow_nan=False))
    assert data["format"] == "cable-model/1"
    bending = data["bending"]
    assert bending["rigidity_n_m2"] == pytest.approx(model.values[:6].tolist())
    assert bending["arc_length_m"] == pytest.approx(np.linspace(0.0, 0.1, 6).tolist())
    k, ke, ref = 4.0, bending["k_e_1_per_m"], bending["k_ref_1_per_m"]
    power = (bending["exponent"] - 1.0) / 2.0
    moment = bending["rigidity_n_m2"][0] * k * ((k**2 + ke**2) / ref**2) ** power
    assert moment == pytest.approx(model.values[0] * 4.0 * (16.01 / 100.0) ** -0.035, rel=1e-9)


def test_effects_and_covariance_have_names_units_and_laws(flat_model):
    model = flat_model(2, air_drag={"drag_coefficient": 2.0}, tip_mass={"mass_kg": 1e-5})
    data = description(model)
    drag, tip = data["effects"]
    assert drag["parameters"][0]["value"] == pytest.approx(2.0)
    assert "v_n" in drag["law"]
    assert tip["parameters"][0]["unit"] == "kg"
    covariance = data["covariance"]
    assert covariance["names"] == list(model.space.names)
    assert covariance["coordinates"][0] == "natural logarithm"
    assert covariance["coordinates"][-1] == "as it is, kg"
    assert np.shape(covariance["matrix"]) == (len(model.mean),) * 2
    low, high = model.interval()
    assert data["bending"]["exponent_interval"] == [low[6], high[6]]
