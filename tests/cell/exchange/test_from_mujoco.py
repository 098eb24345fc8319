"""Models of chains: our own come back, another's are what a beam's formulas say."""

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cell.exchange.from_mujoco import model_from_mujoco
from cell.files.input_error import InputError

pytest.importorskip("mujoco")

#: Of EI at every knot, of N, and of viscosity: what an export and a fit to it may change.
RIGIDITY, EXPONENT, VISCOSITY = 1e-4, 1e-4, 1e-6


@pytest.mark.parametrize("exponent", [0.85, 1.0, 1.2])
@pytest.mark.parametrize("links", [14, 40])
def test_an_exported_cable_comes_back(flat_model, chain_xml, exponent, links):
    model = flat_model(3, exponent)
    found = model_from_mujoco(chain_xml(model, links))
    assert found.notes == ()
    assert found.model.space.names == model.space.names
    k = model.space.knots
    assert found.model.values[:k] == pytest.approx(model.values[:k], rel=RIGIDITY)
    assert found.model.values[k] == pytest.approx(exponent, abs=EXPONENT)
    assert found.model.values[k + 1] == pytest.approx(model.values[k + 1], rel=VISCOSITY)
    assert vars(found.model.space.cable) == pytest.approx(vars(model.space.cable))


def test_nothing_is_claimed_to_have_been_measured(flat_model, chain_xml):
    found = model_from_mujoco(chain_xml(flat_model(3), 14)).model
    assert (found.method, found.frames_used) == ("imported", 0)
    low, high = found.interval()
    assert np.all(high[:6] / low[:6] > 10.0)
    again = type(found).from_dict(found.to_dict())
    assert again.values == pytest.approx(found.values)


def test_what_is_not_read_is_told(flat_model, chain_xml):
    model = flat_model(
        3, 0.93, air_drag={"drag_coefficient": 2.0}, added_mass={"kg_per_m": 5e-4},
        natural_curvature={"curvature_1_per_m": 2.0}, tip_mass={"mass_kg": 5e-5},
        grip_compliance={"rad_per_n_m": 200.0},
        stress_relaxation={"fraction": 0.3, "time_s": 0.1},
    )  # fmt: skip
    found = model_from_mujoco(chain_xml(model, 20))
    told = "\n".join(found.notes)
    for part in ("air", "gravcomp", "springref", "beyond the chain", "grip", "several joints"):
        assert part in told, part
    assert found.model.values[:6] == pytest.approx(model.values[:6], rel=RIGIDITY)
    assert found.model.values[6] == pytest.approx(0.93, abs=EXPONENT)


# --- another's file ------------------------------------------------------------------------------

ABOUT_Y = 'axis="0 1 0"'
LINK_M, STIFFNESS, DAMPING, MASS = 0.02, 2e-3, 1e-6, 1.5e-4


def foreign(links=6, options="", joint="", geom="", hinge=ABOUT_Y) -> str:
    """A rope as the tutorials write it: capsules, hinges about y, hanging down."""
    lines = ["<mujoco>", f"<option {options}/>", "<worldbody>", '<body pos="0 0 1">']
    for i in range(links):
        lines.append(f'<body pos="0 0 {-LINK_M if i else 0}">')
        lines.append(
            f'<joint type="hinge" {hinge if i == 2 else ABOUT_Y} '
            f'stiffness="{STIFFNESS}" damping="{DAMPING}" {joint if i == 2 else ""}/>'
        )
        lines.append(
            f'<geom type="capsule" fromto="0 0 0 0 0 {-LINK_M}" size="0.002" mass="{MASS}" '
            f"{geom if i == 2 else ''}/>"
        )
    lines += [*["</body>"] * (links + 1), "</worldbody>", "</mujoco>"]
    return "\n".join(lines)


def read(tmp_path, text):
    path = tmp_path / "rope.xml"
    path.write_text(text, encoding="utf-8")
    return model_from_mujoco(path)


def test_a_rope_of_another_hand_has_the_rigidity_of_its_springs(tmp_path):
    found = read(tmp_path, foreign())
    cable = found.model.space.cable
    assert cable.free_length_m == pytest.approx(6 * LINK_M)
    assert cable.line_density_kg_per_m == pytest.approx(MASS / LINK_M)
    assert (cable.width_m, cable.thickness_m) == pytest.approx((0.004, np.pi * 0.001))
    arcs = LINK_M * np.arange(6)
    rigidity = found.model.model.rigidity_at(arcs)
    assert rigidity == pytest.approx(STIFFNESS * LINK_M, rel=1e-6)
    assert found.model.values[6] == 1.0
    assert found.model.values[7] == pytest.approx(DAMPING * LINK_M, rel=1e-6)
    assert found.notes == ()


def with_part(part: str) -> str:
    """The same with names, and with a part before its end."""
    text = foreign()
    for i in range(6):
        text = text.replace('<joint type="hinge"', f"<joint name=\"j{i}\" type='hinge'", 1)
        text = text.replace(
            f'<body pos="0 0 {-LINK_M if i else 0}">',
            f"<body name=\"b{i}\" pos='0 0 {-LINK_M if i else 0}'>",
            1,
        )
    return text.replace("</mujoco>", f"{part}\n</mujoco>")


@pytest.mark.parametrize(
    "part",
    [
        '<equality>\n<weld body1="b5"/></equality>',
        '<equality>\n<connect body1="b5" anchor="0 0 -0.02"/></equality>',
        '<equality>\n<joint joint1="j1" joint2="j4"/></equality>',
        '<actuator>\n<position joint="j2" kp="0.05"/></actuator>',
        '<tendon><fixed name="t"><joint joint="j1" coef="1"/><joint joint="j2" coef="1"/></fixed>'
        '</tendon><actuator>\n<motor tendon="t"/></actuator>',
    ],
    ids=["weld", "connect", "coupled joints", "actuator", "actuated tendon"],
)
def test_what_holds_or_drives_the_cable_besides_is_refused(tmp_path, part):
    with pytest.raises(InputError, match=r"the cable.*; remove it"):
        read(tmp_path, with_part(part))


@pytest.mark.parametrize(
    ("joint", "options", "told"),
    [
        ('armature="1e-5"', "", "armature, up to 1e-05 kg·m²"),
        ('limited="true" range="-3 3"', "", "range, up to 3°"),
        ('frictionloss="1e-4"', "", "frictionloss"),
        ("", '><flag gravity="disable"/></option', "gravity is off"),
    ],
)
def test_a_part_of_a_joint_that_is_not_read_is_named(tmp_path, joint, options, told):
    text = foreign(joint=joint)
    if options:
        text = text.replace("<option />", f"<option{options}>")
    assert told in " ".join(read(tmp_path, text).notes)


WRONG = [
    (foreign(links=3), "3 joints with stiffness", "<mujoco>"),
    (foreign(links=4).replace(f'stiffness="{STIFFNESS}" ', "", 1), "3 joints with", "<joint"),
    (foreign(joint='axis="1 0 0"'), "MuJoCo cannot read it", '<joint type="hinge"'),
    (foreign(hinge='axis="1 0 0"'), "turns about another axis", '<joint type="hinge"'),
    (foreign(options='gravity="0 9.81 0"'), "a cable needs its weight", "<option"),
    (foreign().replace("hinge", "slide", 1), "is no hinge", "<joint"),
    (foreign(geom='pos="0.01 0 0"'), "", None),
    (foreign().replace(f'mass="{MASS}"', 'mass="0.9"', 3), "kg/m", None),
    (foreign().replace('size="0.002"', 'size="0.2"'), "kg/m³", None),
    (foreign().replace(f'stiffness="{STIFFNESS}"', 'stiffness="2e6"'), "mind the units", None),
    (foreign().replace("</worldbody>", ""), "MuJoCo cannot read it", None),
    ('{"format": "cable-model/1"}', "MuJoCo cannot read it", None),
    ("", "MuJoCo cannot read it", None),
]


@pytest.mark.parametrize(("text", "said", "line"), WRONG, ids=[w[1] or "off" for w in WRONG])
def test_what_is_no_chain_is_refused_with_line_and_remedy(tmp_path, text, said, line):
    with pytest.raises(InputError) as refused:
        read(tmp_path, text)
    (problem,) = refused.value.problems
    assert re.search(said, problem.message)
    if line is not None:
        assert line in text.splitlines()[problem.line - 1]


# --- anything ------------------------------------------------------------------------------------

NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True).map(str),
    st.sampled_from(["", "x", "0", "-1", "1e-300", "1e300", "1 2 3", "0 0 0", "nan"]),
)


@st.composite
def spoilt(draw, text: str) -> str:
    """A file in which one thing is as somebody's editor, or gripper, may leave it."""
    lines = text.splitlines()
    kind = draw(st.sampled_from(["value", "value", "value", "drop", "twice", "cut", "junk"]))
    i = draw(st.integers(0, len(lines) - 1))
    if kind == "value":
        found = list(re.finditer(r'(\w+)="([^"]*)"', text))
        one = draw(st.sampled_from(found))
        return text[: one.start(2)] + draw(NUMBERS) + text[one.end(2) :]
    if kind == "drop":
        return "\n".join(lines[:i] + lines[i + 1 :])
    if kind == "twice":
        return "\n".join(lines[: i + 1] + lines[i:])
    if kind == "cut":
        return text[: draw(st.integers(0, len(text)))]
    return "\n".join([*lines[:i], draw(st.text(max_size=20)), *lines[i:]])


@settings(
    max_examples=120,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(st.data())
def test_a_spoilt_file_is_a_model_or_refused_in_a_line_of_it(tmp_path_factory, sound, data):
    text = data.draw(spoilt(data.draw(st.sampled_from(sound))))
    path = tmp_path_factory.getbasetemp() / "spoilt.xml"
    path.write_text(text, encoding="utf-8", errors="replace")
    try:
        found = model_from_mujoco(path)
    except InputError as error:
        for problem in error.problems:
            assert problem.path == path
            assert 1 <= problem.line <= max(len(text.splitlines()), 1)
            assert ";" in problem.message or ":" in problem.message  # and what to do
    else:
        assert np.all(np.isfinite(found.model.mean))


@pytest.fixture
def sound(flat_model, chain_xml):
    model = flat_model(3, 0.93, stress_relaxation={"fraction": 0.3, "time_s": 0.1})
    return [foreign(links=5), chain_xml(model, 5).read_text(encoding="utf-8")]
