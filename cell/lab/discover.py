"""Discovers a missing law: admissible terms are tried on the residual, the best kept as a file."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.effects import Effect, load_effect
from cell.files.atomic import write_whole
from cell.lab.diagnose import diagnose
from cell.lab.estimate import estimate
from cell.lab.explore import Candidate, Explorer
from cell.lab.fitting import fit_trials
from cell.lab.rules import Rules
from cell.lab.terms import admissible, effect_source


@dataclass(frozen=True)
class TermFound:
    """A number of the discovered law, with its 95 % interval."""

    name: str
    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Discovery:
    """A law that was found, and what it does to the error on held-out trials (else fitted ones).

    accepted  whether it is significant and confirmed on held-out trials
    """

    terms: tuple[TermFound, ...]
    laws: tuple[str, ...]
    noise_m: float
    before_m: float
    after_m: float
    accepted: bool

    @property
    def removed_share(self) -> float:
        """Share of the error beyond noise (mean square) that is gone."""
        excess = max(self.before_m**2 - self.noise_m**2, 1e-30)
        return float((self.before_m**2 - self.after_m**2) / excess)

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-discovery/1",
            "accepted": self.accepted,
            "laws": list(self.laws),
            "parameters": {
                t.name: {"value": t.value, "low": t.low, "high": t.high, "unit": t.unit}
                for t in self.terms
            },
            "noise_m": self.noise_m,
            "baseline_rms_m": self.before_m,
            "rms_m": self.after_m,
            "removed_share": self.removed_share,
        }


#: Terms are few: all are refitted.
ALL_TERMS = Rules(best=20)


class NothingFoundError(ValueError):
    """No admissible law explains the residual.  Scenario: the model is complete already."""


def discover(explorer: Explorer, out: Path, rules: Rules = ALL_TERMS) -> Discovery:
    """Find the missing law and write it to `out` as an effect.

    The residual is regressed on what each admissible term would do to the markers (a score test
    with the cable's own parameters free), the best are refitted, and terms added one after another
    under the same rules as known effects.  The file is then loaded as any user's and refitted.
    raises  NothingFoundError: nothing written
    """
    terms = {t.name: t for t in admissible(_box(explorer))}
    with tempfile.TemporaryDirectory() as folder:
        tried = {
            n: _loaded(Path(folder) / f"{n}.py", effect_source(n, [t], f"Candidate {n}."))
            for n, t in terms.items()
        }
        search = Explorer(explorer.prepared, explorer.space, tried, explorer.progress)
        examination = diagnose(search, rules)
        found = examination.steps[-1]
        accepted = len(examination.steps) > 1
        if not accepted:
            found = max(examination.singles, key=lambda c: c.evidence, default=found)
            if found is search.baseline() or found.evidence <= search.baseline().evidence:
                raise NothingFoundError(
                    "no admissible law explains the residual better than the model does; "
                    "nothing written"
                )
    kept = [terms[e.name] for e in found.effects if e.name in terms]
    settled = estimate(explorer.prepared, found.fit)
    values = {
        name: interval.value
        for effect in found.effects
        if effect.name in terms
        for name, interval in settled.intervals(effect).items()
    }
    about = f"Law inferred from the residuals of study {explorer.prepared.study.name}."
    source = effect_source("discovered", kept, about, values)
    with tempfile.TemporaryDirectory() as folder:
        effect = _loaded(Path(folder) / out.with_suffix(".py").name, source)
        final = _refit(explorer, effect)
    write_whole(out, source)
    base = explorer.baseline()
    return Discovery(
        terms=tuple(
            TermFound(n, i.value, i.low, i.high, i.unit)
            for n, i in estimate(explorer.prepared, final.fit).intervals(effect).items()
        ),
        laws=tuple(t.law for t in kept),
        noise_m=explorer.prepared.noise.std_m,
        before_m=_error(base),
        after_m=_error(final),
        accepted=accepted,
    )


def _refit(explorer: Explorer, effect: type[Effect]) -> Candidate:
    """The baseline with the effect from its file."""
    own = Explorer(explorer.prepared, explorer.space, {effect.name: effect}, explorer.progress)
    (candidate,) = own.add(own.baseline(), [effect])
    return candidate


def _error(candidate: Candidate) -> float:
    return candidate.heldout.rms_m if candidate.heldout else candidate.fit.rms_m


def _loaded(path: Path, source: str) -> type[Effect]:
    path.write_text(source, encoding="utf-8")
    return load_effect(path)


def _box(explorer: Explorer) -> tuple[float, float, float, float]:
    """Where the cable was seen in the fit trials: x low, x high, y low, y high, m."""
    seen = np.concatenate([t.markers.xy_m.reshape(-1, 2) for t in fit_trials(explorer.prepared)])
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])
