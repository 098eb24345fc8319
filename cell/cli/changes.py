"""What has changed in a line when a run ends, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.cli.making import Products
    from cell.records.result import Result
    from cell.settings.model import Settings


def changes(out: Path, results: Sequence[Result], config: Path, products: Products) -> list[str]:
    """What has changed in the line's cycles, product by product, and what to do; also for a cable
    that was rejected because the model misses it, and for a promoted model that does worse.
    """
    if not products.settings:
        return _changes(out, results, config, products.whole)
    lines = []
    for name, settings in products.settings.items():
        of_it = [r for r in results if r.product == name]
        lines += [f"{name}: {line}" for line in _changes(out, of_it, config, settings)]
    return lines


def _changes(out: Path, results: Sequence[Result], config: Path, settings: Settings) -> list[str]:
    from cell.records.changed_model import newest_models, worsenings
    from cell.records.chart import signals
    from cell.records.ledger.error import LedgerError
    from cell.records.ledger.ledger import Ledger
    from cell.records.mean_error import mean_error
    from cell.settings.referred import line_of

    if not results or results[-1].model is None or settings.ledger is None:
        return []
    try:
        ledger = Ledger(settings.ledger.url or out)
        history = ledger.results(line_of(settings), settings.product)
        ledger.close()
    except LedgerError as error:
        return [f"whether anything has changed cannot be said: {error}"]
    of_model = [r for r in history if r.model == results[-1].model]
    found, common = signals(of_model), mean_error(of_model)
    lines = [*map(str, found), *([] if common is None else [str(common)])]
    unforecast = common is not None or any(not s.of_cables for s in found)
    learn = f"cell learn {out} --config {config}{_of(settings.product)}"
    if unforecast or any(r.model_misses for r in results):
        lines.append(f"to learn what the model lacks: {learn}")
    elif found:
        lines.append(
            "each cable is identified anew, so forecasts follow; to test whether the model lacks "
            f"anything now: {learn}"
        )
    worse = worsenings(history)
    if worse:
        models = newest_models(history)
        assert models is not None, "it is worse than another"
        lines += [*map(str, worse), _taken_back(config, settings, models)]
    return lines


def another_model(config: Path, settings: Settings) -> str:
    """That the settings' file has another model by now than this run was begun with; or ""."""
    from cell.files.input_error import InputError
    from cell.settings import load_settings

    try:
        now, begun = _models(load_settings(config)), _models(settings)
    except InputError:  # it is being edited: whoever reads it next says what is wrong
        return ""
    changed = [name for name, model in begun.items() if now.get(name, model) != model]
    if not changed:
        return ""
    name = changed[0]
    of = f" for {name}" if name else ""
    return (
        f"{config} has another model{of} by now, {now[name]}: the cycles of this run still use "
        f"{begun[name]}, with which it was begun; end it and run again to use the new one"
    )


def _models(settings: Settings) -> dict[str, str]:
    """Hash of every product's model, or that without products as of ""."""
    from cell.settings.loading import products_of
    from cell.settings.translate import model_hash

    return {n: model_hash(s.model) for n, s in (products_of(settings) or {"": settings}).items()}


def _of(product: str | None) -> str:
    return "" if product is None else f" --product {product}"


def _taken_back(config: Path, settings: Settings, models: tuple[str, str]) -> str:
    """Take a promoted model back if the settings say so; what was done, or can be.

    models  hashes of the model that does worse, and of the one before it
    """
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.settings.promotion import undo

    if not settings.promotion.withdraw:
        with suppress(InputError):
            now = _models(load_settings(config)).get(settings.product or "", models[0])
            if now != models[0]:
                return f"{config} has the model {now} by now, not {models[0]}"
        of = _of(settings.product)
        return f"to go back to the model before: cell promote --undo --config {config}{of}"
    try:
        entry = undo(config, settings.product, meant=models)
    except InputError as error:
        return f"the model cannot be taken back: {error}"
    return f"withdrawn, as promotion.withdraw says: {config} has again the model of {entry}"
