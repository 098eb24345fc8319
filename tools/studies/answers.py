"""Result of a diagnosis of a study with a known answer, and whether it is right."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.optimize import linear_sum_assignment

from tools.worlds.known_truth import SHOWS, class_of


@dataclass(frozen=True)
class StudyAnswer:
    """A study and the result of its diagnosis.

    named, partial  effects joined by "+", ties by "|"; also for `cannot_tell`, which claims nothing
    noise_ratio     estimated over true noise; error_ratio: baseline's larger error over true noise
    knots           of EI(s)
    values          of the named effects' parameters
    statistics      of every check, and `accepted`: the effects that the search ended at
                    (`check_ablation.py`); only with --checks
    cpu_s           of the diagnosis with its report's comparison, forks included
    """

    source: str
    kind: str
    number: str
    hidden: str
    unsaid: str
    power: float
    verdict: str
    named: str = ""
    partial: str = ""
    warnings: str = ""
    noise_ratio: float = float("nan")
    error_ratio: float = float("nan")
    simulated_s: float = 0.0
    cpu_s: float = 0.0
    refused: str = ""
    conditions: str = "{}"
    values: str = "{}"
    knots: str = ""
    statistics: str = "{}"
    accepted: str = ""

    @property
    def detectable(self) -> bool:
        return self.power >= SHOWS

    @property
    def right(self) -> bool:
        if self.kind == "prior":
            return not (self.verdict == "complete" and self.error_ratio > 3.0) and not self.wrong
        nameless = self.kind in ("unknown", "outside", "mixed") or self.hidden.startswith("x_")
        if nameless and self.verdict == "unexplained":
            return True
        if not self.hidden:
            return self.verdict == "complete"
        named = self.kind not in ("unknown", "outside") and self.names_all(self.named)
        return named and self.verdict == "missing"

    @property
    def wrong(self) -> bool:
        """Whether a claimed effect is absent, or an incomplete model is called complete."""
        claimed = self.verdict == "missing" and self.names_other(self.named)
        return claimed or (self.source == "rigs" and self.false_complete)

    @property
    def false_complete(self) -> bool:
        return self.verdict == "complete" and bool(self.hidden)

    @property
    def right_in_part(self) -> bool:
        """Whether the partial effects are hidden ones."""
        named = {n for names in _sets(self.partial) for n in names}
        there = all(class_of([h]) & named for h in self._hidden)
        return bool(self.partial) and there and not self.names_other(self.partial)

    def names_all(self, text: str) -> bool:
        """Whether all hidden effects are named, and no absent one."""
        named, there = _sets(text), [*self._hidden, *_split(self.unsaid)]
        worth = [1.0 + (h in self._hidden) for h in there]
        gain = [
            [w * bool(class_of([h]) & n) for n in named] for h, w in zip(there, worth, strict=True)
        ]
        pairs = zip(*linear_sum_assignment(gain, maximize=True), strict=True) if named else ()
        matched = [there[i] for i, j in pairs if gain[i][j]]
        return {*self._hidden} <= {*matched} and len(matched) == len(named)

    def names_other(self, text: str) -> bool:
        """Whether a class of tied effects contains no hidden effect."""
        there = class_of([*self._hidden, *_split(self.unsaid)])
        return any(not names & there for names in _sets(text))

    @property
    def _hidden(self) -> list[str]:
        return _split(self.hidden)


def _split(text: str) -> list[str]:
    return [n for n in text.split("+") if n]


def _sets(text: str) -> list[frozenset[str]]:
    return [frozenset(n.split("|")) for n in _split(text)]
