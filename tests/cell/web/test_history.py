"""The history's page: what charts say belongs to a product."""

from pathlib import Path

import pytest

from cell.records.ledger.ledger import Ledger
from cell.records.result import Result
from cell.settings import load_settings
from cell.settings.referred import line_of
from cell.web.pages import history
from tests.cell.records.ledger.conftest import ended

ROOT = Path(__file__).parents[3]


def test_charts_look_at_one_product_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(results: list[Result]) -> list[str]:
        return [f"{len(results)} cycles"] if results else []

    monkeypatch.setattr(history, "signals", said)
    settings = load_settings(ROOT / "config" / "products.yaml")
    soft, stiff = settings.products
    line = line_of(settings)
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
