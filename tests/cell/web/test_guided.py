"""A calibration step by step: questions, answers, progress, an end before its time."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from calib.store import StoredCalibration, save
from cell.settings import load_settings
from cell.settings.calibrated import devices_of
from cell.settings.model import Calibration
from cell.web.guided import Guided, OpenQuestion, calibrate_command
from cell.web.pages.calibration import parts
from tests.waiting import wait_until

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
#: Speaks as `cell calibrate --dialogue` does.
CHILD = """
import json, sys
def tell(**message): print(json.dumps(message), flush=True)
tell(say="--- camera", done=0, total=0)
tell(ask="show the board; Enter")
tell(say=f"heard {sys.stdin.readline().strip()!r}", done=1, total=2)
print("plain words", flush=True)
print("went wrong", file=sys.stderr, flush=True)
tell(ask="and now?")
sys.exit(0 if sys.stdin.readline() else 3)
"""


@pytest.fixture
def guided() -> Iterator[Guided]:
    guided = Guided()
    yield guided
    guided.close()


def test_questions_are_answered_one_at_a_time(guided: Guided) -> None:
    assert guided.start("calibrate", [sys.executable, "-c", CHILD]) == ""
    assert "is under way" in guided.start("calibrate", [sys.executable, "-c", CHILD])
    wait_until(lambda: guided.state.ask)
    assert guided.state.ask == "show the board; Enter"
    assert "answered already" in guided.answer("n", guided.state.question_number + 1)
    assert guided.answer("n\nx", guided.state.question_number) == ""
    wait_until(lambda: guided.state.ask == "and now?")
    assert guided.state.output == ("--- camera", "heard 'n x'", "plain words")
    assert (guided.state.done, guided.state.total) == (1, 2)
    assert guided.answer("", guided.state.question_number) == ""
    wait_until(lambda: not guided.state.runs)
    assert guided.state.code == 0 and "went wrong" in guided.state.output
    assert guided.start("calibrate", [sys.executable, "-c", CHILD]) == ""


def test_a_second_click_answers_no_question_that_nobody_has_read(guided: Guided) -> None:
    """It said that nobody is near, after which the robot moves."""
    guided.start("calibrate", [sys.executable, "-c", CHILD])
    question = OpenQuestion(guided)
    wait_until(lambda: guided.state.ask)
    assert not question.refresh() and question.refresh()
    assert question.answer("") == ""
    wait_until(lambda: guided.state.ask == "and now?")
    assert "answered already" in question.answer("")
    assert not question.refresh(), "it has just come in sight"
    assert "answered already" in question.answer("")
    assert guided.state.ask == "and now?"
    assert question.refresh() and question.answer("") == ""
    wait_until(lambda: not guided.state.runs)
    assert guided.state.code == 0


def test_it_can_be_ended_before_its_time(guided: Guided) -> None:
    assert guided.cancel() == "nothing is under way"
    assert "No such file" in guided.start("calibrate", ["/no/such/program"])
    guided.start("calibrate", [sys.executable, "-c", CHILD])
    wait_until(lambda: guided.state.ask)
    assert guided.cancel() == ""
    wait_until(lambda: not guided.state.runs)
    assert guided.state.code != 0 and guided.state.ask == ""


def test_the_command_tells_why_it_has_ended(guided: Guided, tmp_path: Path) -> None:
    guided.start("calibrate camera", calibrate_command("camera", CONFIG))  # uncalibrated settings
    wait_until(lambda: not guided.state.runs)
    assert guided.state.code == 2
    assert any("add `calibration: {}`" in line for line in guided.state.output)


def test_age_errors_and_bounds_of_each_calibration(tmp_path: Path) -> None:
    settings = load_settings(CONFIG).model_copy(
        update={"calibration": Calibration(folder=tmp_path)}
    )
    now = datetime.now(UTC)
    made = StoredCalibration(
        "time", now - timedelta(hours=2.0), {}, devices_of(settings),
        {"latency_95_s": 1e-5, "lag_95_s": 2e-3}, {"latency_s": 0.02, "lag_s": 0.03},
    )  # fmt: skip
    save(tmp_path / "time.yaml", made)
    camera, _, times, _ = parts(settings, now)
    assert (camera.made, camera.valid, camera.why) == (None, False, "")
    assert times.age_h == pytest.approx(2.0, abs=1e-3) and times.most_h == 24.0
    assert dict(times.errors) == {"latency 95 %": "0.01 ms ≤ 1 ms", "lag 95 %": "2 ms ≤ 1 ms"}
    assert "lag_95_s" in times.why
    save(tmp_path / "time.yaml", replace(made, error={"lag_95_s": 1e-5}))
    assert parts(settings, now)[2].valid
    assert "h ago" in parts(settings, now + timedelta(days=2))[2].why
    (tmp_path / "time.yaml").write_text("kind: time\n", "utf-8")
    assert parts(settings, now)[2].why


def test_each_product_has_the_grip_that_its_cycles_use(tmp_path: Path) -> None:
    """That of no product, which no cycle uses any more, was called valid; the others missing."""
    settings = load_settings(CONFIG.with_name("products.yaml")).model_copy(
        update={"calibration": Calibration(folder=tmp_path)}
    )
    now = datetime.now(UTC)
    made = StoredCalibration("grip", now, {}, devices_of(settings), {}, {})
    save(tmp_path / "grip.yaml", made)
    save(tmp_path / "grip.stiff.yaml", made)
    found = {p.name: p.valid for p in parts(settings, now)}
    assert found == {
        "camera": False, "cell": False, "time": False, "grip.soft": False, "grip.stiff": True
    }  # fmt: skip
    command = calibrate_command("grip", CONFIG, "stiff")
    assert command[3:7] == ["calibrate", "grip", "--product", "stiff"]
