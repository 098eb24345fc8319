"""`make learn` says before each of its commands what is done and about how long the rest takes."""

import importlib.util
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[3] / "tools"


@pytest.fixture
def learn(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    spec = importlib.util.spec_from_file_location("learn_tool", TOOLS / "learn.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "learn_tool", module)
    spec.loader.exec_module(module)
    return module


def test_the_time_left_is_corrected_by_the_time_taken(learn, monkeypatch, capsys):
    ticks = iter([0.0, 48.0, 48.0, 108.0])
    monkeypatch.setattr(
        learn.subprocess, "run", lambda *a, **k: learn.subprocess.CompletedProcess(a, 0)
    )
    commands = learn.Commands((24.0, 60.0, 2.0, 24.0), clock=lambda: next(ticks))
    assert commands.run("run") == 0
    commands.run("learn", "folder")
    said = capsys.readouterr().out.splitlines()
    assert said == [
        "",
        "step 1 of 4, 0 s so far, about 1.8 min left",
        "$ cell run",
        "",
        "step 2 of 4, 48 s so far, about 2.9 min left",
        "$ cell learn folder",
    ]
    assert commands.left_s() == pytest.approx(26.0 * 108.0 / 84.0)
