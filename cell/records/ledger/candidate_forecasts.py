"""Which share of rejected and missed cables a learned model would have inserted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.files.yaml_document import read_yaml
from cell.records.ledger.ledger import Ledger, LedgerQuery, ListedCycle
from cell.records.result import Outcome
from cell.settings.model import Settings
from cell.settings.promotion import read_candidate

#: Of the share's interval.
CONFIDENCE = 0.95


@dataclass(frozen=True)
class PassingShare:
    """Share of cables whose tip the learned model forecast within the opening, with its interval.

    effects         of the model
    passed, cables  forecasts within the opening, and all: each of a cable that the model before it
                    rejected or missed, from that cable's own hold, without it in the fit
    low, high       95 % interval
    source          Clopper & Pearson 1934, Biometrika 26, 404
    """

    effects: str
    passed: int
    cables: int
    low: float
    high: float

    @classmethod
    def of(cls, effects: str, passed: int, cables: int) -> PassingShare:
        """With the exact interval of a binomial share.  Raises ValueError: 0 cables."""
        from scipy.special import betaincinv

        if not 0 <= passed <= cables or not cables:
            raise ValueError(f"{passed} of {cables} cables is no share; give 0 ≤ passed ≤ cables")
        tail, failed = 0.5 * (1.0 - CONFIDENCE), cables - passed
        low = float(betaincinv(passed, failed + 1, tail)) if passed else 0.0
        high = float(betaincinv(passed + 1, failed, 1.0 - tail)) if failed else 1.0
        return cls(effects, passed, cables, low, high)

    def __str__(self) -> str:
        return (
            f"with {self.effects} {self.passed} of {self.cables} forecasts pass "
            f"({self.low:.0%} to {self.high:.0%})"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {**asdict(self), "share": self.passed / self.cables}


@dataclass(frozen=True)
class CandidateForecasts:
    """Forecasts of recorded cables by a model of `cell learn`.

    model   hash of the model that the line had when it was learned
    counts  outcome → forecasts within the opening, and all
    """

    effects: str
    model: str
    counts: Mapping[str, tuple[int, int]]

    def share(self, cycles: Sequence[ListedCycle]) -> PassingShare | None:
        """Of cycles of one outcome; None = cannot tell: another model, or nothing was forecast."""
        outcomes = {c.outcome for c in cycles}
        if {c.model for c in cycles} != {self.model} or len(outcomes) != 1:
            return None
        passed, cables = self.counts.get(outcomes.pop(), (0, 0))
        return PassingShare.of(self.effects, passed, cables) if cables else None


def read_forecasts(path: Path, settings: Settings, ledger: Ledger) -> CandidateForecasts:
    """Forecasts in a candidate's file, of cycles that the ledger knows as rejected or missed.

    settings  whose opening the tip must be forecast in, to half its height
    raises    InputError: the file is no candidate, or its forecasts are damaged; LedgerError
    """
    candidate = read_candidate(path)
    document = read_yaml(path)
    try:
        errors_m = {
            str(f["cycle"]): float("inf") if f["candidate_m"] is None else float(f["candidate_m"])
            for f in document.data.get("forecasts", [])
        }
    except (TypeError, KeyError, ValueError) as error:
        message = "need cycle and candidate_m in metres; learn it again"
        raise InputError([document.problem(("forecasts",), message)]) from error
    low_m, high_m = settings.destination.y_m
    outcomes = (Outcome.REJECTED.value, Outcome.MISSED.value)
    counts: dict[str, tuple[int, int]] = {}
    for cycle in ledger.listed(LedgerQuery(model=candidate.beside, outcomes=outcomes)):
        if cycle.folder.name in errors_m:
            passed, cables = counts.get(cycle.outcome, (0, 0))
            passes = errors_m[cycle.folder.name] < 0.5 * (high_m - low_m)
            counts[cycle.outcome] = passed + passes, cables + 1
    names = [Path(effect.effect).stem for effect in candidate.model.effects]
    return CandidateForecasts(" + ".join(names), candidate.beside, counts)
