"""An effect of one's own that gets stuck, or fails, only in a fit is named by the command."""

from pathlib import Path

import numpy as np
import pytest

from cell.cable.model import CableModel
from cell.study.data import Study, Trial
from cell.study.folder import write_study
from tools.worlds.made_studies import CABLE, filmed, moved

from .forked import Forking

IMPATIENT = "from cell.computer import watched; watched.PATIENCE_S = 1.0"

HEAD = '''"""Mine."""
from cell.cable.effects import Effect, Parameter

calls = []

class Mine(Effect):
    """Fails late."""

    name = "mine"
    parameters = (Parameter("size", "1", 0.0, 0.01, default=0.0, starts=(1e-4,)),)

'''
LATE = "abs(at.time - 0.5) < 1e-3 and abs(at.arc_length - 0.05) < 4e-3 and at.tx < -0.2"
COMPILED = HEAD + (
    "    def force(cable, at, p):\n"
    "        k = 0.0\n"
    f"        while {LATE} and k > -1.0:\n"
    "            k += 1.0\n"
    "        return 0.0, p.size * at.vx\n"
)
IN_PYTHON = HEAD + (
    "    def extra_length(cable, p):\n"
    "        calls.append(0)\n"
    "        while len(calls) > 30:\n"
    "            pass\n"
    "        return p.size\n"
)
IN_C = IN_PYTHON.replace("while len", "if len").replace("pass\n", "sum(range(10**13))\n")
RAISES = COMPILED.replace("while", "if").replace("k += 1.0", "raise KeyError('deep')")
RAISES_IN_PYTHON = IN_PYTHON.replace("while", "if").replace("pass\n", "raise KeyError('deep')\n")
ENDS = "takes more than 1 s, as a loop without end does: mend that"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("studies") / "small"
    t = np.arange(0.0, 0.9, 0.02)
    grip, arcs = moved(t, (0.0, -0.05), 0.2), np.linspace(0.1, 0.0, 3)
    model = CableModel.uniform(CABLE, 3e-5, viscosity_n_m2_s=1e-7)
    seen = filmed(np.random.default_rng(1), model, grip, t, arcs)
    trial = Trial("a", "fit", "equilibrium", grip, seen)
    write_study(Study("s", CABLE, arcs, (trial,)), folder)
    return folder


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (COMPILED, 12, f"mine: a compiled hook {ENDS}"),
        (IN_PYTHON, 12, f"mine.extra_length {ENDS}"),
        (IN_C, 12, f"mine.extra_length {ENDS}"),
        (RAISES, 15, "mine: a compiled hook: KeyError: 'deep'"),
        (RAISES_IN_PYTHON, 15, "mine.extra_length: KeyError: 'deep'"),
    ],
    ids=["compiled", "python", "in C", "raises compiled", "raises in Python"],
)
def test_the_command_ends_and_names_effect_file_and_line(
    forking: Forking, study: Path, tmp_path: Path, text: str, line: int, said: str
) -> None:
    path, out = tmp_path / "mine.py", tmp_path / "model.json"
    path.write_text(text)
    done = forking.start("fit", study, "--with", path, "-o", out, first=IMPATIENT)
    _, err = done.communicate(timeout=120)
    assert done.returncode == 2
    assert err.decode().splitlines()[-1] == f"{path}:{line}: {said}"
    assert not out.exists()


LATER = HEAD.replace('"""Mine."""', '"""Mine."""\nimport os') + (
    "    def extra_length(cable, p):\n"
    "        while os.environ.get('STUCK'):\n"
    "            pass\n"
    "        return p.size\n"
)


@pytest.fixture(scope="module")
def tried(forking: Forking, study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a study, and a model fitted to it with an effect that has passed its trial."""
    folder = tmp_path_factory.mktemp("tried")
    (folder / "mine.py").write_text(LATER)
    (folder / "study").symlink_to(study)
    fit = ("fit", "study", "--with", "mine.py", "-o", "model.json")
    done = forking.start(*fit, first=f"{IMPATIENT}; import os; os.chdir({str(folder)!r})")
    assert done.wait(120) == 0, done.communicate()
    return folder


@pytest.mark.parametrize(
    "words", [["effects", "--try", "mine.py"], ["compare", "study", "--model", "model.json"]]
)
def test_an_effect_that_was_tried_before_and_is_stuck_now_is_named(
    forking: Forking, tried: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    """It is not tried elsewhere again; loading it hung for ever."""
    monkeypatch.chdir(tried)
    done = forking.start(*words, environment={"STUCK": "1"}, first=IMPATIENT)
    _, err = done.communicate(timeout=120)
    assert (done.returncode, err.decode().splitlines()[-1:]) == (
        2, [f"{tried / 'mine.py'}:13: mine.extra_length {ENDS}"],
    )  # fmt: skip
