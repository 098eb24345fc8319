"""What waits survives, results above all."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.plant.messages import MessageKind, Notice
from cell.plant.mqtt.outbox import MqttOutbox, OutboxError, outbox_of


def notice(sequence: int, kind: MessageKind = MessageKind.STEP) -> Notice:
    return Notice("r", sequence, 1.5, kind, {"cycle": sequence})


def test_what_waits_is_there_again_in_its_order(tmp_path: Path) -> None:
    path = outbox_of(tmp_path / "runs")
    box = MqttOutbox(path, 1000)
    assert box.newest() is None
    for sequence in (1, 2, 3):
        box.put(notice(sequence))
    first = box.first()
    assert first is not None
    box.remove(first)
    box.close()
    box = MqttOutbox(path, 1000)
    assert (box.count(), box.newest(), box.dropped()) == (2, ("r", 3), 0)
    waiting = box.first()
    assert waiting is not None
    assert waiting.notice == notice(2)
    assert [box.count_up("births"), box.count_up("births")] == [1, 2]
    box.close()


def test_too_many_lose_the_oldest_that_are_no_results(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    box = MqttOutbox(tmp_path / "box.sqlite", 10)
    for sequence in range(1, 21):
        box.put(notice(sequence, MessageKind.RESULT if sequence % 2 else MessageKind.STEP))
    assert (box.count(), box.dropped()) == (10, 10)
    assert "the oldest 1 that are not results were dropped" in caplog.text
    box.put(notice(21, MessageKind.RESULT))
    kept = []
    while (waiting := box.first()) is not None:
        kept.append(waiting.notice.sequence)
        box.remove(waiting)
    assert kept == list(range(1, 22, 2))
    box.close()


def test_two_adapters_cannot_use_one_file(tmp_path: Path) -> None:
    box = MqttOutbox(tmp_path / "box.sqlite", 10)
    with pytest.raises(OutboxError, match="another adapter uses"):
        MqttOutbox(tmp_path / "box.sqlite", 10)
    box.close()


def test_a_file_that_is_no_outbox_is_refused(tmp_path: Path) -> None:
    (tmp_path / "box.sqlite").write_bytes(b"no database" * 500)
    with pytest.raises(OutboxError, match=r"box\.sqlite: .*move the file away"):
        MqttOutbox(tmp_path / "box.sqlite", 10)
