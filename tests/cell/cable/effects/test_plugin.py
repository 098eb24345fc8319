"""A user's own effect: the documented example, and mistakes named with file and line."""

import os
import re
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import EffectError, library, load_effect
from cell.cable.effects.compiled import loops_of
from cell.cable.effects.remote import MARK
from cell.cable.geometry import Cable
from cell.cable.model import CableModel

DOCS = Path(__file__).parents[4] / "docs" / "howto" / "own_effect.md"

HEAD = """from cell.cable.effects import Effect, Parameter
class Mine(Effect):
    name = "mine"
    parameters = (Parameter("size", "1", 0.0, 1.0, 0.0, (0.5,)),)
"""

FORCE = HEAD + "    def force(cable, at, p):\n"


def written(folder, text):
    path = folder / "mine.py"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_documented_example_runs(tmp_path, monkeypatch):
    example, use, _memory = re.findall(r"```python\n(.*?)```", DOCS.read_text("utf-8"), re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) <= 20
    (tmp_path / "magnet.py").write_text(example, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(use, "docs/howto/own_effect.md", "exec"), names)
    model, still = names["model"], names["still"]
    plain = CableModel.uniform(model.cable, 3e-5, viscosity_n_m2_s=1e-7)
    off = CableModel.uniform(
        model.cable, 3e-5, viscosity_n_m2_s=1e-7, effects=(names["magnet"].active(),)
    )
    times, arc = np.array([0.0, 0.5]), np.array([0.05, 0.1])
    without = simulate([plain, off], still, times, arc)
    assert without[0] == pytest.approx(without[1], abs=1e-12)
    assert names["xy"][0, -1, -1, 1] < without[0, -1, -1, 1] - 1e-4  # it pulls down


def test_a_script_without_a_main_part_may_load_an_effect(tmp_path):
    """Python's starter of processes runs the script once more in each."""
    written(tmp_path, FORCE + "        return 0.0, -p.size*at.vy\n")
    script = tmp_path / "script.py"
    script.write_text(
        "from cell.cable.effects import load_effect\nprint(load_effect('mine.py').name)\n", "utf-8"
    )
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "mine\n"), done.stderr


def test_a_file_is_run_as_it_stands_and_nothing_is_left_beside_it(tmp_path, monkeypatch):
    """Python trusts its code on disk if size and second are those of the file."""
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    path = written(tmp_path, FORCE + "        return -p.size*at.vx, 0.0\n")
    os.utime(path, (1e9, 1e9))
    assert load_effect(path).parameters[0].high == 1.0
    path.write_text(path.read_text("utf-8").replace("0.0, 1.0, 0.0", "0.0, 9.0, 0.0"), "utf-8")
    os.utime(path, (1e9, 1e9))
    assert load_effect(path).parameters[0].high == 9.0
    assert list(tmp_path.iterdir()) == [path]


def test_changing_a_value_compiles_nothing(tmp_path, cable, arc, jerk):
    effect = load_effect(written(tmp_path, FORCE + "        return -p.size*at.vx, 0.0\n"))
    loops = loops_of(effect)
    for size in (0.1, 0.2):
        model = CableModel.uniform(cable, 3e-5, effects=(effect.active(size=size),))
        simulate(model, jerk, np.array([0.0, 0.2]), arc)
    assert loops_of(effect) is loops
    (module,) = loops.alive
    assert len(module.loop.overloads) == 1


SLEEVE = """import numpy as np
from cell.cable.effects import Effect, Parameter
class Sleeve(Effect):
    name = "sleeve"
    parameters = (Parameter("kg", "kg", 0.0, 1.0, 0.0, (1e-5,)),)
    def inertia(cable, arc_length, p):
        near = np.exp(-0.5 * ((arc_length / cable.free_length_m - 0.6) / 0.02) ** 2)
        per_m = p.kg * near / (0.02 * cable.free_length_m * np.sqrt(2.0 * np.pi))
        return per_m, per_m
"""


@pytest.mark.parametrize("trusted", [True, False])
def test_an_inertia_may_depend_on_arc_length(tmp_path, cable, arc, jerk, trusted):
    """Without gravity a narrow one is a point mass."""
    if not trusted:
        if sys.platform != "linux":
            pytest.skip("there is no sandbox elsewhere")
        (tmp_path / MARK).touch()
    sleeve, t_s = load_effect(written(tmp_path, SLEEVE)), np.arange(0.0, 0.8, 0.02)
    point, mass_kg = library()["point_mass"], 1e-4

    def swing(*effects):
        model = CableModel.uniform(cable, 3e-5, 1.0, 1e-7, (0.0, 0.0), effects)
        return simulate(model, jerk, t_s, arc)[0]

    bare, there = swing(), swing(sleeve.active(kg=mass_kg))
    at_point = swing(point.active(mass_kg=mass_kg, place=0.6))
    assert np.abs(at_point - bare).max() > 2e-3
    assert np.abs(there - at_point).max() < 0.02 * np.abs(at_point - bare).max()


@pytest.mark.parametrize("trusted", [True, False])
def test_what_the_program_wrote_is_compiled_once_wherever_it_lies(tmp_path, monkeypatch, trusted):
    """Every search for a law wrote all of them to a new folder, and compiled them for 9 s.

    A user's file may import from its folder: that of another folder is another effect.
    """
    module_of = sys.modules[load_effect.__module__]
    monkeypatch.setattr(module_of, "try_effect", lambda *_: None)  # it compiles, too
    text = FORCE + f"        return 0.0, -p.size*at.vy  # {uuid4()}\n"  # never compiled before
    found = []
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        effect = load_effect(written(tmp_path / name, text), trusted=trusted)
        assert effect.file.path == (tmp_path / name / "mine.py").resolve()
        (module,) = loops_of(effect).alive
        found.append(sum(module.loop.stats.cache_hits.values()))
    assert found == [0, 1 if trusted else 0]


def test_an_edited_file_is_compiled_anew(tmp_path, cable, arc, jerk):
    tips = []
    for factor in (1.0, 2.0):
        text = FORCE + f"        return 0.0, -{factor}*p.size\n"
        effect = load_effect(written(tmp_path, text))
        model = CableModel.uniform(cable, 3e-5, effects=(effect.active(size=0.01),))
        tips.append(simulate(model, jerk, np.array([0.0]), arc)[0, 0, -1, 1])
    assert tips[1] < tips[0] - 1e-4


def test_an_exception_while_running_is_not_swallowed(tmp_path, cable, arc, jerk):
    text = (
        FORCE + "        if at.x > 30.0:\n"
        "            raise ValueError('beyond the wall')\n"
        "        return 0.0, 0.0 * p.size\n"
    )
    effect = load_effect(written(tmp_path, text))
    away = type(jerk)(jerk.t_s, jerk.x_m + 31.0, jerk.y_m, jerk.angle_rad)
    model = CableModel.uniform(cable, 3e-5, effects=(effect.active(size=0.1),))
    with pytest.raises(ValueError, match="beyond the wall"):
        simulate(model, away, np.array([0.0, 0.1]), arc)


def test_a_table_that_is_too_short_for_a_cable_is_no_numbers_from_elsewhere(tmp_path, jerk):
    """Where it is tried, on a cable of 100 mm, its eleven values are enough."""
    head = "import numpy as np\nTABLE = np.ones(11)\n" + FORCE
    text = head + "        return 0.0, -1e-3 * p.size * TABLE[int(at.arc_length / 0.01)]\n"
    effect = load_effect(written(tmp_path, text))
    longer = CableModel.uniform(
        Cable(0.2, 0.0074, 0.016, 1e-4), 2e-4, effects=(effect.active(size=0.5),)
    )
    with pytest.raises(EffectError, match=r"mine.py:7: .*index is out of bounds"):
        simulate(longer, jerk, np.array([0.0, 0.1]), np.array([0.2]))


MISTAKES = {
    "syntax": ("class Mine(:\n", 1, "syntax"),
    "import": ("import nowhere_to_be_found\n", 1, "ModuleNotFoundError"),
    "no effect": ("x = 1\n", 1, "exactly one"),
    "wrong hook": (HEAD + "    def forces(cable, at, p):\n        return 0.0, 0.0\n", 5, "'force'"),
    "arguments": (HEAD + "    def force(at, p):\n        return 0.0, 0.0\n", 5, "(cable, at, p)"),
    "name": (FORCE + "        f = 1.0\n        return p.sice, f\n", 7, "sice"),
    "shape": (FORCE + "        return 1.0\n", 5, "tuple of 2 numbers"),
    "nan": (FORCE + "        return float('nan'), 0.0\n", 5, "finite"),
    "division": (
        FORCE + "        return p.size / (at.vx - 0.3), 0.0\n",
        6,
        "ZeroDivisionError",
    ),
    "always on": (FORCE + "        return 0.0, 1.0\n", 5, "not off at size = 0"),
    "arguments of an inertia": (
        HEAD + "    def inertia(p):\n        return 0.0, 0.0\n",
        5,
        "needs (cable, p) or (cable, arc_length, p)",
    ),
    "shape of an inertia": (
        HEAD + "    def inertia(cable, arc_length, p):\n"
        "        return p.size * arc_length[1:], 0.0\n",
        5,
        "returned shape (4,): must be (along, normal), each a number or of shape (5,)",
    ),
    "inertia without an end": (
        HEAD + "    def inertia(cable, arc_length, p):\n"
        "        return 0.0, p.size / (arc_length - 0.05)\n",
        5,
        "not finite",
    ),
    "an inertia always on": (
        HEAD + "    def inertia(cable, arc_length, p):\n        return 0.0, arc_length\n",
        5,
        "not off at size = 0",
    ),
    "no hook": (HEAD, 2, "does nothing"),
    "feeds": (
        HEAD + "    dissipative = True\n    def force(cable, at, p):\n"
        "        return p.size * at.vx, p.size * at.vy\n",
        6,
        "although declared dissipative",
    ),
    "feeds by bending": (
        HEAD + "    dissipative = True\n    def moment(cable, at, m, p):\n"
        "        return -1e-6 * p.size * at.rate\n",
        6,
        "although declared dissipative",
    ),
    "memory without rate": (
        HEAD + "    memory = ('z',)\n"
        "    def moment(cable, at, m, p):\n        return p.size * m.z\n",
        2,
        "memory_rate",
    ),
    "import in a hook": (
        FORCE + "        import os\n        return -p.size * at.vx, 0.0\n",
        6,
        "plain arithmetic on numbers: Use of unsupported opcode (IMPORT_NAME)",
    ),
    "exit": ("import sys\n\nsys.exit(0)\n", 3, "SystemExit: 0"),
    "exit in a hook": (FORCE + "        raise SystemExit\n", 6, "mine.force: SystemExit"),
    "end of the process": ("import os\n\nos._exit(0)\n", 1, "its module ends the process"),
    "loop": ("while True:\n    pass\n", 1, "its module takes more than 3 s, as a loop without end"),
    "loop in a hook": (
        FORCE + "        while True:\n            pass\n",
        5,
        "mine.force takes more than 3 s, as a loop without end",
    ),
    "loop in some states": (
        FORCE + "        y = at.y\n        while -0.015 > y > -0.0199 and p.size > 0.0:\n"
        "            y = 0.5 * (y + at.y)\n        return -p.size * at.vx, 0.0\n",
        5,
        "mine: a hook, in some state of a swing, takes more than 3 s",
    ),
    "all memory": (FORCE + "        x = [0] * 10**10\n        return x[0], 0.0\n", 6, "MemoryErr"),
    "a library effect's name": (
        FORCE.replace('"mine"', '"air_drag"') + "        return -p.size * at.vx, 0.0\n",
        2,
        "name = 'air_drag' is the library's own effect; give yours another name",
    ),
    "very long": ("x = 1\n" * 20_000, 1, "is it an effect?"),
    "not compilable": (
        FORCE + "        return p.size * len({'a': [1], 2: 3}), 0.0\n",
        6,
        "cannot be compiled",
    ),
    "parameters": (
        "from cell.cable.effects import Effect, Parameter\nclass Mine(Effect):\n    name = 'mine'\n"
        "    parameters = (Parameter('size', '1', 0.0, 1.0, 2.0, (0.5,)),)\n",
        4,
        "default 2.0 outside 0.0 … 1.0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", sorted(MISTAKES))
def test_a_mistake_is_refused_with_its_line(tmp_path, mistake):
    text, line, cause = MISTAKES[mistake]
    path = written(tmp_path, text)
    with pytest.raises(EffectError) as caught:
        load_effect(path)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert cause in str(caught.value)
