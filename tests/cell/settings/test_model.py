"""The section `model`: what it means for a cable, and every mistake in it at its place."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from cell.files.input_error import InputError
from cell.settings import load_settings
from cell.settings.model import Workers
from cell.settings.plant import Plant
from cell.settings.translate import cable_of, identification_of, model_class_of, model_hash

FAKE = (Path(__file__).parents[3] / "config" / "fake.yaml").read_text(encoding="utf-8")

MODEL = """
model:
  effects:
  - effect: air_drag
    parameters:
      drag_coefficient: {fixed: 2.0, std: 0.1}
  - effect: stress_relaxation
    parameters:
      fraction: prior
      time_s: {fixed: 0.2}
  prior:
    names: [exponent, viscosity, stress_relaxation.fraction]
    mean: [1.0, 1.0e-7, 0.15]
    covariance: [[0.0025, 0, 0], [0, 0.16, 0], [0, 0, 0.0004]]
"""

MAGNET = '''"""A pull."""

from cell.cable.effects import Effect, Parameter


class Magnet(Effect):
    """Constant pull to the right."""

    name = "magnet"
    parameters = (Parameter("pull_n_per_m", "N/m", 0.0, 1.0, default=0.0, starts=(1e-4,)),)

    def force(cable, at, p):
        return p.pull_n_per_m, 0.0
'''


def settings_with(tmp_path: Path, model: str) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(FAKE + model, encoding="utf-8")
    return path


def test_a_cable_gets_the_effects_and_the_prior_of_its_batch(tmp_path: Path) -> None:
    settings = load_settings(settings_with(tmp_path, MODEL))
    space = model_class_of(settings.model).space(cable_of(settings))
    assert [e.name for e in space.effects] == ["air_drag", "stress_relaxation"]
    assert space.exact == (("stress_relaxation.time_s", 0.2),)
    assert "stress_relaxation.time_s" not in space.names
    natural = dict(zip(space.names, space.natural(space.mean), strict=True))
    assert natural["air_drag.drag_coefficient"] == pytest.approx(2.0)
    assert natural["viscosity"] == pytest.approx(1e-7)
    std = np.sqrt(np.diag(np.linalg.inv(space.precision)))
    stds = dict(zip(space.names, std, strict=True))
    assert stds["air_drag.drag_coefficient"] == pytest.approx(0.1)
    assert stds["viscosity"] == pytest.approx(0.4)
    assert stds["stress_relaxation.fraction"] == pytest.approx(0.02)
    model = space.model(space.mean)
    assert model.effects[1].named == {"fraction": pytest.approx(0.15), "time_s": 0.2}


def test_a_model_may_have_nothing_but_a_batchs_prior(tmp_path: Path) -> None:
    """As `cell promote` writes an effect of several parameters into settings without a model."""
    prior = """
model:
  effects:
  - {effect: stress_relaxation, parameters: {fraction: prior, time_s: prior}}
  prior:
    names: [stress_relaxation.fraction, stress_relaxation.time_s]
    mean: [0.15, 0.2]
    covariance: [[0.0004, 0.001], [0.001, 0.01]]
"""
    kind = model_class_of(load_settings(settings_with(tmp_path, prior)).model)
    assert kind.names == ("stress_relaxation.fraction", "stress_relaxation.time_s")
    assert kind.covariance == ((0.0004, 0.001), (0.001, 0.01))


def test_an_effect_of_a_file_lies_beside_the_settings_and_is_checked(tmp_path: Path) -> None:
    (tmp_path / "magnet.py").write_text(MAGNET, encoding="utf-8")
    path = settings_with(tmp_path, "\nmodel: {effects: [{effect: magnet.py}]}\n")
    settings = load_settings(path)
    entry = settings.model.effects[0]
    assert entry.effect == str(tmp_path / "magnet.py")
    kind = identification_of(settings).kind
    assert kind.effects[0].name == "magnet"
    # another process gets the same effect, and of the same content there is one class
    assert pickle.loads(pickle.dumps(kind)) == kind
    changed = FAKE + f"\nmodel: {{effects: [{{effect: magnet.py, sha256: {entry.sha256}}}]}}\n"
    path.write_text(changed, encoding="utf-8")
    assert model_hash(load_settings(path).model) == model_hash(settings.model)
    (tmp_path / "magnet.py").write_text(MAGNET + "\n# changed\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"is not the file that this model was learned with"):
        load_settings(path)


def test_the_hash_is_of_what_the_model_says(tmp_path: Path) -> None:
    first = load_settings(settings_with(tmp_path, MODEL))
    other = load_settings(settings_with(tmp_path, MODEL.replace("2.0, std", "2.1, std")))
    again = load_settings(settings_with(tmp_path, MODEL + "# a comment\n"))
    assert model_hash(first.model) == model_hash(again.model) != model_hash(other.model)


MISTAKES = [
    # old, new, line within the section, what is said
    ("effect: air_drag", "effect: air_drga", 3, "unknown effect; did you mean 'air_drag'?"),
    ("effect: air_drag", "effect: mine.py", 3, "no such effect file"),
    ("effect: stress_relaxation", "effect: air_drag", 6, "air_drag is given twice"),
    ("drag_coefficient:", "drag_coeficient:", 5, "has no such parameter; did you mean 'drag_coeff"),
    ("fixed: 2.0", "fixed: -2.0", 5, "-2: must be 0 … 50"),
    ("std: 0.1", "std: -0.1", 5, "greater than or equal to 0"),
    ("time_s: {fixed: 0.2}", "time_s: prior", 9, "model.prior.names has no 'stress_relaxation"),
    ("fraction: prior", "fraction: fitted", 8, "write 'prior'"),
    ("fraction: prior", "fraction: {fixed: 0.1}", 11, "is `fixed` above; take it out of the prior"),
    ("names: [exponent", "names: [exponnt", 10, "no fitted parameters ['exponnt']"),
    ("[exponent, viscosity", "[exponent, exponent", 10, "exponent is given twice"),
    ("[exponent, ", "[exponent, rigidity_0, ", 10, "needs 4 rows of 4 numbers, one per name"),
    ("[0.0025, 0, 0]", "[0.0025, 0]", 10, "needs 3 rows of 3 numbers, one per name"),
    ("mean: [1.0, ", "mean: [10, ", 10, "exponent = 10: must be"),
    ("mean: [1.0, ", "mean: [", 10, "needs one mean per name"),
    ("[0.0025, 0, 0]", "[-0.0025, 0, 0]", 10, "not symmetric and positive definite"),
    ("mean: [1.0, 1.0e-7", "mean: [1.0, 1.0", 10, "viscosity = 1 N·m²·s: must be"),
    ("\nmodel:", "\nidentification: {method: paper}\nmodel:", 1, "'paper' knows neither effects"),
]


@pytest.mark.parametrize(("old", "new", "line", "said"), MISTAKES, ids=[m[3] for m in MISTAKES])
def test_a_mistake_is_named(tmp_path: Path, old: str, new: str, line: int, said: str) -> None:
    assert old in MODEL
    path = settings_with(tmp_path, MODEL.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_settings(path)
    problem = caught.value.problems[0]
    assert said in str(problem)
    assert problem.line == FAKE.count("\n") + 1 + line


@pytest.mark.parametrize(
    ("said", "place"),
    [
        ({}, None),
        ({"cores": 3}, 3),
        ({"cluster": "tcp://scheduler:8786"}, "tcp://scheduler:8786"),
    ],
)
def test_a_place_is_a_cluster_or_cores(said, place):
    assert Workers.model_validate(said).place == place


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"cluster": "scheduler:8786"}, "give 2, or tcp://host:8786"),
        ({"cluster": "3"}, "is no address of a scheduler; give tcp://host:8786"),
        ({"cores": 0}, "greater than or equal to 1"),
        ({"cluster": "tcp://a:1", "cores": 2}, "has both `cluster` and `cores`; leave one out"),
    ],
)
def test_what_is_no_place_is_refused(said, message):
    with pytest.raises(ValidationError, match=message):
        Workers.model_validate(said)


def test_what_is_started_has_its_section() -> None:
    assert Plant().start == ()
    assert Plant.model_validate({"start": ["opcua"], "opcua": {}}).start == ("opcua",)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"start": ["mqtt"]}, "start names mqtt, which has no section; add mqtt: to plant"),
        ({"start": ["opcua", "opcua"], "opcua": {}}, "start names opcua twice; once is enough"),
        ({"start": ["profinet"]}, "'opcua', 'mqtt' or 'handshake'"),
    ],
)
def test_what_cannot_be_started_is_refused(said: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Plant.model_validate(said)
