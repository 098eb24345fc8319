"""What has changed in a line when a run ends, and what to do about it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.records.result import Result
    from cell.settings.model import Settings


def changes(out: Path, results: list[Result], config: Path, settings: Settings) -> list[str]:
    """What has changed in the line's cycles, and what to do; also for a cable that was rejected
    because the model misses it, and for a promoted model that does worse.
    """
    from cell.records.changed_model import worsenings
    from cell.records.chart import signals
    from cell.records.ledger.error import LedgerError
    from cell.records.ledger.ledger import Ledger
    from cell.records.mean_error import mean_error
    from cell.settings.referred import line_of

    if not results or results[-1].model is None or settings.ledger is None:
        return []
    try:
        ledger = Ledger(settings.ledger.url or out)
        history = ledger.results(line_of(settings))
        ledger.close()
    except LedgerError as error:
        return [f"whether anything has changed cannot be said: {error}"]
    of_model = [r for r in history if r.model == results[-1].model]
    found, common = signals(of_model), mean_error(of_model)
    lines = [*map(str, found), *([] if common is None else [str(common)])]
    unforecast = common is not None or any(not s.of_cables for s in found)
    if unforecast or any(r.model_misses for r in results):
        lines.append(f"to learn what the model lacks: cell learn {out} --config {config}")
    elif found:
        lines.append(
            "each cable is identified anew, so forecasts follow; to test whether the model lacks "
            f"anything now: cell learn {out} --config {config}"
        )
    worse = worsenings(history)
    if worse:
        lines += [*map(str, worse), _taken_back(config, settings.promotion.withdraw)]
    return lines


def another_model(config: Path, settings: Settings) -> str:
    """That the settings' file has another model by now than this run was begun with; or ""."""
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.settings.translate import model_hash

    try:
        now, begun = model_hash(load_settings(config).model), model_hash(settings.model)
    except InputError:  # it is being edited: whoever reads it next says what is wrong
        return ""
    if now == begun:
        return ""
    return (
        f"{config} has another model by now, {now}: the cycles of this run still use {begun}, with "
        "which it was begun; end it and run again to use the new one"
    )


def _taken_back(config: Path, withdraw: bool) -> str:
    """Take a promoted model back if the settings say so; what was done, or can be."""
    from cell.files.input_error import InputError
    from cell.settings.promotion import undo

    if not withdraw:
        return f"to go back to the model before: cell promote --undo --config {config}"
    try:
        entry = undo(config)
    except InputError as error:
        return f"the model cannot be taken back: {error}"
    return f"withdrawn, as promotion.withdraw says: {config} has again the model of {entry}"
