"""What the pages show, of what is known of the cell and of cycles of the ledger."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, time
from pathlib import Path

import pytest

from cell.plant.messages import FaultNotice, MessageKind, Notice, Status
from cell.records.folder import UNFINISHED
from cell.records.ledger.effectiveness import Shift, shift_start
from cell.records.ledger.ledger import Ledger, ListedCycle
from cell.records.result import Result
from cell.run.machine import CellState, MachineEvent
from cell.run.plans import INSERTING
from cell.settings import load_settings
from cell.settings.loading import products_of
from cell.settings.provenance import line_name
from cell.web import theme
from cell.web.pages import history
from cell.web.theme import AWAY, LOOKS
from cell.web.views import (
    STEPS,
    adapters_text,
    error_chart,
    fault_texts,
    history_row,
    live_view,
    miss_chart,
    reasons_text,
    result_figures,
    why_disabled,
)
from cell.web.watching import ShiftFigures, WatchedState, shift_figures, state_after
from cell.web.wording import sentences, translation
from drivers.interfaces import ArmMode, too_late
from tests.cell.records.ledger.conftest import ended

RESULT = {
    "cycle": 3,
    "outcome": "inserted",
    "folder": "/runs/20261121T021043.800-3",
    "predicted_miss_m": -0.0010,
    "measured_miss_m": -0.0000001,
    "probability": 0.9995,
    "margin_m": None,
}
IDLE = Status("run", 1, CellState.IDLE, 0.0, possible=(MachineEvent.START, MachineEvent.STOP))


def notice(kind: MessageKind, at_s: float = 0.0, **data: object) -> Notice:
    return Notice("run", 2, at_s, kind, data)


def test_every_state_has_a_look_and_every_step_a_word() -> None:
    assert set(LOOKS) == set(CellState)
    known = sentences("de")
    assert all(known.find(style.word) for style in LOOKS.values())
    assert set(INSERTING.names) <= set(STEPS)


def test_before_a_cell_was_seen_nothing_can_be_pressed() -> None:
    view = live_view(WatchedState(), 10.0)
    assert (view.style, view.buttons, view.fault, view.folder) == (AWAY, frozenset(), None, "")


def test_a_step_is_shown_with_its_time_until_the_state_changes() -> None:
    seen = state_after(WatchedState(), IDLE)
    assert live_view(seen, 0.0).buttons == {MachineEvent.START, MachineEvent.STOP}
    seen = state_after(seen, notice(MessageKind.STATE, state="execute", step=None, since=1.0))
    seen = state_after(seen, notice(MessageKind.CYCLE, cycle=3, part=None, product=None))
    seen = state_after(seen, notice(MessageKind.STEP, 5.0, step="lower", cycle=3))
    view = live_view(seen, 7.5)
    assert (view.style.word, view.step, view.step_s, view.cycle) == ("Execute", "lowering", 2.5, 3)
    assert view.step_share == 0.0  # nobody knows how long it takes
    for usual_s, share in ((10.0, 0.25), (2.0, 1.0)):
        ended = {**RESULT, "seconds": {"lower": usual_s}}
        known = replace(seen, status=replace(seen.status, last=ended))
        assert live_view(known, 7.5).step_share == share
    assert live_view(seen, 4.0).step_s == 0.0  # clocks differ a little
    seen = state_after(seen, notice(MessageKind.STATE, state="held", step=None, since=9.0))
    assert live_view(seen, 9.0).step_s is None


def test_a_cell_that_has_gone_shows_its_newest_cable_and_no_buttons() -> None:
    seen = state_after(state_after(WatchedState(), IDLE), notice(MessageKind.RESULT, **RESULT))
    view = live_view(replace(seen, connected=False), 0.0)
    assert (view.style, view.buttons) == (AWAY, frozenset())
    assert (view.folder, view.counts) == ("20261121T021043.800-3", {"inserted": 1})
    assert view.result == {
        "Predicted miss": "-1.00 mm",
        "Measured miss": "+0.00 mm",
        "Probability": "> 99.9 %",
    }


def test_a_fault_is_shown_with_cause_and_remedy_until_it_is_acknowledged() -> None:
    fault = FaultNotice(3, "lower", "limit", 0.0, "arm", "move it back", "a cable is in the jaws")
    seen = state_after(WatchedState(), replace(IDLE, fault=fault, waiting_for=("acknowledgement",)))
    view = live_view(seen, 0.0)
    assert view.fault is not None
    remedies = "move it back\na cable is in the jaws"
    assert fault_texts(view.fault, str) == ("Fault: arm, lowering", "limit", remedies)
    assert view.waiting == ("acknowledgement",)
    seen = state_after(seen, notice(MessageKind.ACKNOWLEDGED, by="Ada", note="looked"))
    assert live_view(seen, 0.0).fault is None


def test_an_adapter_in_trouble_is_named_until_it_runs_again() -> None:
    trouble = "has ended: signal 9; it is started again"
    seen = state_after(WatchedState(), IDLE)
    seen = state_after(seen, notice(MessageKind.ADAPTER, adapter="opcua", trouble=trouble))
    assert adapters_text(live_view(seen, 0.0).adapters, str) == f"OPC UA {trouble}"
    assert live_view(replace(seen, connected=False), 0.0).adapters == {}
    seen = state_after(seen, notice(MessageKind.ADAPTER, adapter="opcua", trouble=""))
    assert live_view(seen, 0.0).adapters == {}


def test_figures_of_the_shift_come_from_the_ledger() -> None:
    at = datetime(2026, 11, 25, 6, tzinfo=UTC)
    shift = Shift(at, at, 100.0, 50.0, 5.0, 8, 6)
    seen = WatchedState(figures=ShiftFigures({"inserted": 6}, shift, (("arm.limit", 2, "limit"),)))
    view = live_view(seen, 0.0)
    texts = {"Yield": "75%", "Availability": "50%", "Performance": "80%", "OEE": "30%"}
    assert view.shift == texts
    unplanned = replace(seen, figures=replace(seen.figures, is_planned=False))
    assert live_view(unplanned, 0.0).shift == {"Yield": "75%", "Performance": "80%"}
    none = replace(shift, cables=0, inserted=0, running_s=0.0)
    seen = WatchedState(figures=ShiftFigures({}, none, ()))
    assert live_view(seen, 0.0).shift["Yield"] == "–"


def test_the_shift_under_way_may_have_begun_yesterday() -> None:
    times = [time(6), time(14), time(22)]
    night = datetime(2026, 11, 25, 3, 0).astimezone()
    assert shift_start(times, night) == datetime(2026, 11, 24, 22, 0).astimezone()
    assert shift_start(times, night.replace(hour=14)).hour == 14


def test_cycles_as_rows_and_errors_as_a_chart() -> None:
    at = datetime(2026, 11, 25, 6, tzinfo=UTC)
    numbers = {"predicted_miss_m": 1e-3, "measured_miss_m": 1.5e-3, "predicted_std_m": 1e-4}
    good = ListedCycle(
        *("line", 1, "<b>", "soft", Path("/runs/a"), at, at, "inserted", *[None] * 5),
        numbers,
        None,
    )
    row = history_row(good, str)
    assert (row["part"], row["predicted"], row["measured"]) == ("<b>", "+1.00", "+1.50")
    unknown = replace(good, numbers={}, reason="too stiff", outcome="rejected")
    assert (history_row(unknown, str)["predicted"], history_row(unknown, str)["why"]) == (
        "",
        "too stiff",
    )
    cycles = [replace(good, cycle=41), replace(unknown, cycle=42)]
    chart = error_chart(cycles, ("error", "expected", "none", "cable"))
    assert chart["xAxis"]["data"] == ["41", "42"]
    errors, high, low, none = (s["data"] for s in chart["series"])
    assert (errors[0]["value"], errors[0]["itemStyle"]) == (0.5, {"color": theme.RED})
    assert (errors[1], high, low) == (None, [0.3, None], [-0.3, None])
    assert none == [None, 0.0]
    assert error_chart([unknown], ("", "", "", ""))["xAxis"]["data"] == []
    products = products_of(load_settings(ROOT / "config" / "products.yaml"))
    (name, stiff), usual = list(products.items())[-1], load_settings(ROOT / "config" / "fake.yaml")
    cycles += [replace(good, product=name)]
    chart = miss_chart(cycles, ("", "", "", ""), {name: stiff}, usual)
    misses, high, *_ = (s["data"] for s in chart["series"])
    halves = [0.5e3 * (s.destination.y_m[1] - s.destination.y_m[0]) for s in (usual, stiff)]
    assert misses == [1.5, None, 1.5]
    assert high == pytest.approx([halves[0], halves[0], halves[1]])


def test_a_button_that_cannot_be_pressed_says_why() -> None:
    view = live_view(state_after(WatchedState(), IDLE), 0.0)
    assert why_disabled(MachineEvent.START, view, in_control=True) == ""
    assert why_disabled(MachineEvent.START, view, in_control=False) == "Take control first."
    assert why_disabled(MachineEvent.STOP, view, in_control=False) == ""
    assert why_disabled(MachineEvent.HOLD, view, in_control=True) == "Not possible in this state."
    nothing = live_view(WatchedState(), 0.0)
    assert why_disabled(MachineEvent.STOP, nothing, in_control=True) == "No cell runs"


def test_without_a_cell_the_newest_cable_is_that_of_the_ledger(tmp_path: Path) -> None:
    settings = load_settings(ROOT / "config" / "fake.yaml")
    runs = tmp_path / "runs"
    ledger = Ledger(runs, create=True)
    made = [ended(n, line=line_name(settings), product=None) for n in range(1, 24)]
    ledger.write(made)
    ledger.close()
    figures = shift_figures(settings, runs, datetime.now().astimezone())
    view = live_view(WatchedState(figures=figures), 0.0)
    assert [c.cycle for c in view.newest] == list(range(4, 24))
    assert (view.outcome, view.folder) == (view.newest[-1].outcome, view.newest[-1].folder.name)


def test_counts_have_one_order_and_a_cycle_under_way_is_no_killed_one() -> None:
    counts = {"failed": 1, UNFINISHED: 2, "inserted": 5}
    figures = ShiftFigures(counts, None, ())
    status = replace(IDLE, state=CellState.EXECUTE, step="lower")
    seen = replace(state_after(WatchedState(), status), figures=figures)
    expected = [("inserted", 5), ("failed", 1), ("under way", 1), ("broken off", 1)]
    assert list(live_view(seen, 0.0).counts.items()) == expected
    held = replace(seen, status=replace(status, state=CellState.HELD, step=None))
    assert list(live_view(held, 0.0).counts.items()) == expected
    idle = replace(seen, status=IDLE)
    assert list(live_view(idle, 0.0).counts.items())[2:] == [("broken off", 2)]


def test_a_german_page_says_causes_remedies_and_reasons_in_german() -> None:
    t, error = translation("de"), too_late("arm", 0.0123)
    remedy, cable = ArmMode.PROTECTIVE_STOP.remedy, "a cable is in the jaws"
    fault = FaultNotice(3, "lower", error.cause, 0.0, "arm", remedy, cable)
    trouble = "has ended: exit code 1; it is started again, at least every minute"
    status = replace(IDLE, fault=fault, adapters={"handshake": trouble})
    missed = "the tip missed the destination by 1.20 mm"
    figures = ShiftFigures({}, None, (("missed", 2, missed), ("arm.limit", 1, error.cause)))
    view = live_view(replace(state_after(WatchedState(), status), figures=figures), 0.0)
    assert view.fault is not None
    late = "der Befehl kam 12,3 ms nach dem Zeitpunkt, zu dem er beginnen sollte"
    assert fault_texts(view.fault, t) == (
        "Störung: Arm, Absenken",
        late,
        "Ursache suchen, nach 5 s am Bediengerät entriegeln, dann zurücksetzen\n"
        "ein Kabel ist im Greifer",
    )
    again = "es wird neu gestartet, mindestens jede Minute"
    assert adapters_text(view.adapters, t) == (
        f"Handshake mit der SPS endete: Rückgabewert 1; {again}"
    )
    assert reasons_text(figures.reasons, t) == (
        f"2 × verfehlt: die Spitze verfehlte das Ziel um 1,20 mm\n1 × arm.limit: {late}"
    )
    at = datetime(2026, 11, 25, 6, tzinfo=UTC)
    cycle = ListedCycle(
        *("line", 1, "", "", Path("/runs/a"), at, at, "missed", *[None] * 5), {}, None
    )
    row = history_row(replace(cycle, reason=missed, numbers={"measured_miss_m": 1.5e-3}), t)
    assert (row["outcome"], row["measured"]) == ("verfehlt", "+1,50")
    assert row["why"] == "die Spitze verfehlte das Ziel um 1,20 mm"


def test_a_probability_is_100_percent_only_if_it_is() -> None:
    texts = [result_figures({"probability": p})["Probability"] for p in (1.0, 0.99996, 0.9, 1e-5)]
    assert texts == ["100.0 %", "> 99.9 %", "90.0 %", "< 0.1 %"]
    assert translation("de")(texts[1]) == "> 99,9 %"


ROOT = Path(__file__).parents[3]


def test_charts_look_at_one_product_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(results: list[Result]) -> list[str]:
        return [f"{len(results)} cycles"] if results else []

    monkeypatch.setattr(history, "signals", said)
    settings = load_settings(ROOT / "config" / "products.yaml")
    soft, stiff = settings.products
    line = line_name(settings)
    ledger = Ledger(tmp_path / "runs", create=True)
    made = [soft, stiff, soft, None]
    ledger.write([ended(n, line=line, product=of) for n, of in enumerate(made, 1)])
    assert history.changes_of(ledger, settings, None, str) == [
        f"{soft}: 2 cycles",
        f"{stiff}: 1 cycles",
    ]
    assert history.changes_of(ledger, settings, stiff, str) == [f"{stiff}: 1 cycles"]
    alone = settings.model_copy(update={"products": {}})
    assert history.changes_of(ledger, alone, None, str) == ["1 cycles"]
    ledger.close()


def test_the_manual_is_linked_where_it_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(theme, "MANUAL", tmp_path)
    assert theme.manual_page("index.html") == ""
    (tmp_path / "index.html").touch()
    assert theme.manual_page("index.html") == "/manual/index.html"
