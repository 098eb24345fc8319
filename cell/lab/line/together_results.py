"""What several studies say together, as data (cable-together/1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from cell.files.plain import plain
from cell.lab.data.results import Verdict

#: What a study says of the effects that were found: it shows them, excludes them at the size that
#: the others show, or cannot tell.
Says = Literal["shows", "excludes", "cannot tell"]


@dataclass(frozen=True)
class StudyPart:
    """One study's part in the answer.

    alone         verdict of the study alone
    missing       effects that it alone finds missing, each with those tied with it
    delta_chi2    by which the effects of the answer lower χ² over all its trials
    explained     whether the model with these effects leaves noise there; or without them, where
                  the study does not show them
    says          of these effects; "" if there are none
    """

    study: str
    alone: Verdict
    missing: tuple[tuple[str, ...], ...]
    delta_chi2: float
    explained: bool
    says: Says | Literal[""]

    def finds(self, effects: Sequence[str]) -> bool:
        """Whether the study alone says that each of these effects is missing, or one tied with it.

        Then its held-out trials have confirmed them.
        """
        return self.alone == "missing" and all(
            any(effect in names for names in self.missing) for effect in effects
        )


@dataclass(frozen=True)
class StudyValue:
    """A parameter by one study alone, with its 95 % interval."""

    study: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Consistency:
    """A parameter of the effects found, over the studies that do not exclude them.

    value, low, high     mean and its 95 % interval
    tau                  standard deviation between cables: of ln(value) if `logarithmic`
    q_p_value            of values so far apart by chance (Cochran's Q)
    without_low, without_high   smallest and largest mean with one study left out
    """

    parameter: str
    unit: str
    logarithmic: bool
    value: float
    low: float
    high: float
    tau: float
    q_p_value: float
    without_low: float
    without_high: float
    by_study: tuple[StudyValue, ...]


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects that was tried on all studies.

    evidence    ln likelihood less BIC's penalty, beyond the model without them, all studies
    delta_chi2  by which χ² falls, all studies
    """

    effects: tuple[str, ...]
    evidence: float
    delta_chi2: float


@dataclass(frozen=True)
class Together:
    """One answer of several studies, or why there is none.

    why         in a sentence
    effects     missing in the model; empty if none is
    tied        sets of effects that explain as much
    hypotheses  all that were tried, the likeliest first
    """

    verdict: Verdict
    why: str
    effects: tuple[str, ...]
    tied: tuple[tuple[str, ...], ...]
    studies: tuple[StudyPart, ...]
    consistency: tuple[Consistency, ...]
    hypotheses: tuple[Hypothesis, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {"format": "cable-together/1", **plain(asdict(self))}
