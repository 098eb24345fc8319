"""A candidate model held against the gates of a line, which `learning_checks.GATES` lists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cell.lab.data.check import CheckOutcome
from cell.lab.line.forecasts import ForecastPair, forecasts
from cell.lab.line.learn import LearningResult
from cell.lab.line.learning_checks import gate_outcomes
from cell.lab.line.learning_questions import LineEvidence, forecast_better
from cell.plan.destination import Destination
from cell.settings import Settings
from cell.settings.translate import cable_of, identification_of


@dataclass(frozen=True)
class Judgement:
    """Conditions that a candidate was held against, and the forecasts they rest on."""

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
    result: LearningResult, settings: Settings, known: Sequence[ForecastPair] = ()
) -> Judgement:
    """The candidate held against every condition, for the line of these settings.

    known   forecasts of the present model that were made already; of any candidate
    raises  as `identification_of`
    """
    if result.best is None:
        return Judgement()
    destination = Destination(*settings.destination.x_m, *settings.destination.y_m)
    cable, options = cable_of(settings), identification_of(settings)
    paired = forecasts(result, cable, options, destination, known)
    return Judgement(tuple(gates(result, paired, destination)), tuple(paired))


def gates(
    result: LearningResult, paired: Sequence[ForecastPair], destination: Destination
) -> list[CheckOutcome[LineEvidence]]:
    """All conditions that apply, each with what was found."""
    return gate_outcomes(LineEvidence(result, paired, destination))


def best_judged(
    result: LearningResult, settings: Settings, known: Sequence[ForecastPair] = ()
) -> tuple[LearningResult, Judgement]:
    """The result, or the simpler one in it if its last effect does not help; and its judgement.

    The last effect helps if with it unseen cables are forecast better than without, by the gate
    that a first effect must pass.
    known   as in `judge`
    """
    judgement = judge(result, settings, known)
    if result.simpler is None:
        return result, judgement
    simpler = replace(
        result.simpler, left_out=result.left_out, cables_left_out=result.cables_left_out
    )
    simpler, without = best_judged(simpler, settings, judgement.paired)
    pairs = zip(without.paired, judgement.paired, strict=True)
    gained = [
        replace(after, present_m=before.candidate_m, present_rms_m=before.candidate_rms_m)
        for before, after in pairs
    ]
    evidence = LineEvidence(result, gained)
    rules = evidence.rules
    helps = len(gained) >= rules.fewest and forecast_better(evidence).value <= rules.significance
    if judgement.fit_for_line and helps:
        return result, judgement
    return simpler, without
