"""Products by turns: each with its settings, model, records; jaws are emptied before a change."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from cell.cli.cell_factory import build_cell, products_in
from cell.plant.messages import CommandReply, MessageKind, Notice, Request, Status, status_after
from cell.plant.reporter import Reporter
from cell.plant.service import Service
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.result import Outcome, Result
from cell.run.machine import CellState, MachineEvent
from cell.settings.loading import load_product
from cell.settings.translate import model_hash

from .conftest import _QUICK, _SMALL, CONFIG, changed, run, unrecorded

PRODUCTS = CONFIG.with_name("products.yaml")
STIFF_QUICK = [("hold_s: 0.9", "hold_s: 0.4")]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("products") / "products.yaml"
    return unrecorded(changed(PRODUCTS, path, [*_QUICK, *_SMALL, *STIFF_QUICK]))


def test_scanned_parts_are_made_by_turns_and_an_unknown_one_is_not(
    config: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    command = ("run", "-c", config, "--cycles", 3, "--part-id", "-", "--runs", runs, "--json")
    done = run(*command, typed="S-1\nT-1\nX-9\nS-2\n")
    assert done.returncode == 0, done.stderr
    assert "part 'X-9' matches part_ids of no product" in done.stderr
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(r["part"], r["product"]) for r in results] == [
        ("S-1", "soft"),
        ("T-1", "stiff"),
        ("S-2", "soft"),
    ]
    for result in results:
        folder, settings = Path(result["folder"]), load_product(config, result["product"])
        assert result["model"] == model_hash(settings.model)
        recorded = yaml.safe_load((folder / "settings.yaml").read_text("utf-8"))
        assert recorded["cable"] == settings.cable.model_dump(mode="json")
        assert recorded["product"] == result["product"]
        assert json.loads((folder / "state.json").read_text())["product"] == result["product"]
    ledger = Ledger(runs)
    assert [c.part for c in ledger.listed(LedgerQuery(product="soft"))] == ["S-1", "S-2"]
    assert [c.part for c in ledger.listed(LedgerQuery(product="stiff"))] == ["T-1"]
    line = ledger.listed(LedgerQuery())[0].line
    assert [r.product for r in ledger.results(line, "stiff")] == ["stiff"]
    assert ledger.results(line) == [], "charts of no product see none of theirs"
    ledger.close()
    listed = json.loads(run("history", "--runs", runs, "--product", "stiff", "--json").stdout)
    assert [c["part"] for c in listed] == ["T-1"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "which product"),
        (("--product", "short"), "'short' is no product"),
        (("--product", "soft", "--part-id", "T-1"), "part 'T-1' is of product stiff, not soft"),
        (("--part-id", "X-1"), "matches part_ids of no product"),
    ],
)
def test_what_is_not_known_to_be_made_moves_nothing(
    config: Path, tmp_path: Path, words: tuple[str, ...], says: str
) -> None:
    done = run("run", "-c", config, "--runs", tmp_path / "runs", *words)
    assert done.returncode == 2
    assert says in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.fixture
def serving(config: Path, tmp_path: Path) -> Iterator[SimpleNamespace]:
    """A service of the simulated cell in a thread, and its status as programs see it."""
    it = SimpleNamespace(steps=[], results=[], at={}, status=None, changed=threading.Condition())

    def on_step(number: int, step: str) -> None:
        it.service.step(number, step)
        it.steps.append((number, step))
        if step in it.at:
            it.at.pop(step)()

    def publish(kind: MessageKind, data: Any) -> None:
        with it.changed:
            it.status = status_after(it.status, Notice("", it.status.sequence + 1, 0.0, kind, data))
            it.changed.notify_all()

    def until(reached: Callable[[Status], bool]) -> None:
        with it.changed:
            assert it.changed.wait_for(lambda: reached(it.status), 60.0), it.status

    products = products_in(config, None)
    known = products.calibrations["soft"]
    it.made = build_cell(
        products, "soft", known, tmp_path / "runs", seed=1, cycles=None, on_step=on_step
    )
    it.status = Status("", 0, CellState.STOPPED, 0.0, products=products.names)
    about = {n: {"model": t.task.model, "calibration": None} for n, t in it.made.tasks.items()}
    it.service = Service(
        it.made.cell,
        Reporter(publish, about),
        tmp_path / "runs",
        products=products.patterns,
        select_product=it.made.change_product,
    )
    it.until = until
    working = threading.Thread(target=it.service.run, args=(it.results.append,), daemon=True)
    working.start()
    yield it
    it.service.end()
    working.join(60.0)
    assert not working.is_alive(), it.status
    it.made.cell.close()


def idle(status: Status) -> bool:
    return status.state is CellState.IDLE


def steps_of(it: SimpleNamespace, number: int) -> list[str]:
    return [step for cycle, step in it.steps if cycle == number]


def test_starts_choose_products_and_a_change_empties_the_jaws_first(
    serving: SimpleNamespace,
) -> None:
    def start(**of: str) -> CommandReply:
        serving.until(idle)
        return serving.service.answer(Request(MachineEvent.START, "plc", **of))

    def ended(count: int) -> Result:
        serving.until(lambda s: sum(s.counts.values()) == count)
        return serving.results[-1]

    refused = start()
    assert not refused.accepted and "which product" in refused.reason
    assert "is of product stiff, not soft" in start(product="soft", part="T-1").reason
    assert "'long' is not known, but soft, stiff" in start(product="long").reason

    # while it waits in Idle, made ready for the soft one, the jaws get hold of something
    gripper = serving.made.twins.gripper
    serving.at["empty_jaws"] = lambda: gripper.grip(20.0)
    seen: dict[str, Any] = {}

    def look() -> None:
        hand = serving.made.twins.world.gripper_pose()
        seen.update(holding=gripper.state().holding, hand_m=(hand.x_m, hand.y_m))

    def ask_for_the_other() -> None:
        """While the cycle of this one is under way, which it stays."""
        seen["answer"] = serving.service.answer(Request(None, "plc", product="soft"))
        seen["status"] = serving.status

    serving.at |= {"check_paths": look, "grasp": ask_for_the_other}
    assert start(part="T-1").accepted
    models = {name: task.task.model for name, task in serving.made.tasks.items()}
    first = ended(1)
    assert (first.product, first.outcome) == ("stiff", Outcome.INSERTED)
    assert first.model == models["stiff"]
    order = steps_of(serving, 1)
    assert order.index("empty_jaws") < order.index("grasp")
    changed_over = ["empty_jaws", "check_paths", "reset", "start"]
    assert order[order.index("empty_jaws") :][:4] == changed_over
    aside = serving.made.tasks["soft"].task.aside
    assert not seen["holding"]
    assert seen["hand_m"] == pytest.approx((aside.x_m, aside.y_m), abs=1e-4)
    assert seen["answer"].accepted
    assert (seen["status"].product, seen["status"].model) == ("stiff", models["stiff"])

    serving.until(idle)
    assert serving.status.product == "soft" and serving.status.model == models["soft"]
    assert steps_of(serving, 2)[:2] == ["empty_jaws", "reset"], "its paths are checked already"
    assert start().accepted
    assert ended(2).product == "soft"
    assert start(part="S-2").accepted, "no change: nothing is emptied"
    assert ended(3).product == "soft"
    assert "empty_jaws" not in steps_of(serving, 3)


def test_a_change_that_is_stopped_is_made_again_before_the_next_cycle(
    serving: SimpleNamespace,
) -> None:
    serving.until(idle)
    stop = Request(MachineEvent.STOP, "plc", note="guard opened")
    serving.at["empty_jaws"] = lambda: serving.service.answer(stop)
    assert serving.service.answer(Request(MachineEvent.START, "plc", product="stiff")).accepted
    serving.until(lambda s: s.fault is not None)
    assert serving.results[-1].product == "stiff"
    serving.until(lambda s: s.state is CellState.STOPPED)
    assert "grasp" not in steps_of(serving, 1)
    assert serving.service.answer(Request(MachineEvent.RESET, "Ada", note="closed")).accepted
    serving.until(idle)
    assert steps_of(serving, 2)[:3] == ["empty_jaws", "check_paths", "reset"]
