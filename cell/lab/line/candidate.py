"""A candidate model as a file: section `model` of the settings, and the evidence for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from cell.files.atomic import write_atomic
from cell.files.plain import plain
from cell.files.yaml_document import yaml_text
from cell.identify.model_class import source_of
from cell.lab.data.check import CheckOutcome
from cell.lab.data.cycles import RecordedCycle
from cell.lab.line.effect_fit import LearningResult
from cell.lab.line.forecasts import ForecastPair, forecasts
from cell.lab.line.learning_checks import (
    LineEvidence,
    gain_p_value,
    gate_outcomes,
    learning_outcomes,
    learning_verdict,
)
from cell.plan.destination import Destination
from cell.settings import Settings, load_settings
from cell.settings.model import ModelSettings
from cell.settings.promotion import FORMAT, distinct, line_identity
from cell.settings.translate import cable_of, identification_of, model_hash


@dataclass(frozen=True)
class Judgement:
    """Results of a candidate's gates, and the forecasts behind them."""

    gates: tuple[CheckOutcome[LineEvidence], ...] = ()
    paired: tuple[ForecastPair, ...] = ()

    @property
    def fit_for_line(self) -> bool:
        """Whether every condition is met."""
        return all(gate.passed for gate in self.gates)

    @property
    def failed(self) -> list[str]:
        """Names of the conditions that are not met."""
        return [gate.name for gate in self.gates if not gate.passed]


def judge(
    result: LearningResult, settings: Settings, existing: Sequence[ForecastPair] = ()
) -> Judgement:
    """The gates of a candidate, evaluated for the line of these settings.

    existing  forecasts, whose part by the present model is reused
    raises    as `identification_of`
    """
    if result.best is None:
        return Judgement()
    destination = Destination(*settings.destination.x_m, *settings.destination.y_m)
    cable, options = cable_of(settings), identification_of(settings)
    paired = forecasts(result, cable, options, destination, existing)
    evidence = LineEvidence(result, paired, destination)
    return Judgement(tuple(gate_outcomes(evidence)), tuple(paired))


def best_judged(
    result: LearningResult, settings: Settings, existing: Sequence[ForecastPair] = ()
) -> tuple[LearningResult, Judgement]:
    """The result, or without its last effect if that does not improve forecasts; its gates.

    The last effect helps if unseen cables are forecast better with it than without, by the same
    gate as for a first effect.
    existing  as in `judge`
    """
    judgement = judge(result, settings, existing)
    if result.simpler is None:
        return result, judgement
    simpler = replace(
        result.simpler, left_out=result.left_out, cables_left_out=result.cables_left_out
    )
    simpler, without = best_judged(simpler, settings, judgement.paired)
    pairs = zip(without.paired, judgement.paired, strict=True)
    gained = [replace(after, present=before.candidate) for before, after in pairs]
    evidence = LineEvidence(result, gained)
    gain = gain_p_value(evidence)
    helps = gain is not None and gain.value <= evidence.rules.significance
    if judgement.fit_for_line and helps:
        return result, judgement
    return simpler, without


def lines_of(cycles: Sequence[RecordedCycle], settings: Settings) -> list[dict[str, Any]]:
    """The different lines that cycles were recorded on; cycles without settings count as this line.

    raises  InputError: a cycle's settings cannot be read
    """
    recorded = [c.folder / "settings.yaml" for c in cycles]
    return distinct(
        [line_identity(load_settings(path) if path.exists() else settings) for path in recorded]
    )


def write_candidate(
    path: Path,
    result: LearningResult,
    judgement: Judgement,
    present: ModelSettings,
    lines: Sequence[Mapping[str, Any]],
    product: str | None = None,
) -> None:
    """Write the learned effects and the cycles behind them; `read_candidate` reads the file.

    present  the model that the effects were learned in addition to
    lines    on which the cycles were recorded, from `lines_of`
    product  of the model; None = settings without products
    """
    outcomes = learning_outcomes(result)
    content = {
        "format": FORMAT,
        **({} if product is None else {"product": product}),
        "beside": model_hash(present),
        "model": section(result, present).model_dump(mode="json", exclude_defaults=True),
        "tied": list(result.tied),
        "verdict": learning_verdict(result, outcomes),
        "checks": [plain(vars(outcome.result)) for outcome in outcomes],
        "gates": [
            {"gate": g.name, "passed": g.passed, "found": g.text, **plain(vars(g.result))}
            for g in judgement.gates
        ],
        "forecasts": [pair.to_json() for pair in judgement.paired],
        "votes": [plain(vars(v)) for v in result.cycle_evidence],
        "left_out": [*result.cables_left_out, *result.left_out],
        "lines": list(lines),
        "cycles": [str(c.folder.resolve()) for c in result.cycles],
    }
    write_atomic(path, yaml_text(content))


def section(result: LearningResult, present: ModelSettings) -> ModelSettings:
    """Settings section `model`: the present model with the learned effects.

    One parameter is written as `fixed` with its standard deviation, several as a prior, because
    they depend on each other.
    """
    assert result.best is not None
    best, fit = result.best, result.best.fit
    covariance = fit.covariance + np.diag(result.between)
    natural = fit.natural()[fit.common]
    content = present.model_dump(mode="json")
    for effect in best.effects:
        fitted = [n.partition(".")[2] for n in best.names if n.startswith(f"{effect.name}.")]
        entry: dict[str, Any] = {"effect": source_of(effect)}
        if effect.file is not None:
            entry["sha256"] = effect.file.sha256
        entry["parameters"] = dict.fromkeys(fitted, "prior")
        content["effects"].append(entry)
    if len(best.names) == 1:
        logarithmic = bool(fit.space.logarithmic[fit.common[0]])
        std = float(np.sqrt(covariance[0, 0])) * (float(natural[0]) if logarithmic else 1.0)
        name = best.names[0].partition(".")[2]
        estimate = {"fixed": _digits(natural[0]), "std": _digits(std)}
        content["effects"][-1]["parameters"] = {name: estimate}
    else:
        old = content["prior"] or {"names": [], "mean": [], "covariance": []}
        k = len(old["names"])
        joint = block_diag(np.array(old["covariance"]).reshape(k, k), covariance)
        content["prior"] = {
            "names": [*old["names"], *best.names],
            "mean": [*old["mean"], *(_digits(v) for v in natural)],
            "covariance": [[_digits(v) for v in row] for row in joint],
        }
    return ModelSettings.model_validate(content)


def _digits(value: float) -> float:
    """Six digits: fewer could make a covariance matrix indefinite."""
    return float(f"{float(value):.6g}")
