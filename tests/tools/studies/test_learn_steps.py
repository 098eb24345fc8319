"""`make learn` says before each of its commands what is done and about how long the rest takes."""

import pytest

from tools.studies import learn


def test_the_time_left_is_corrected_by_the_time_taken(monkeypatch, capsys):
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
