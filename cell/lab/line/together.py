"""Joint diagnosis of several studies: one set of missing effects, or the reason for none.

Each study keeps its own cable, noise and parameters.  Each candidate set of effects, proposed by
one study or by all jointly, is fitted to every study; the ln likelihoods are summed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import stdtrit as t_quantile

from cell.cable.arrays import FloatArray
from cell.files.plain import plain
from cell.lab.data.results import Verdict
from cell.lab.data.thresholds import Rules
from cell.lab.fit.shared import Spread
from cell.lab.line.cables_space import ranked_by_screens
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.checks import explains
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.evidence import Evidence

#: Sets of effects that are fitted to all studies, and how many of them by the sum of the screens.
MOST_SETS, BY_SCREENS = 8, 2
#: Of a normal distribution, for 95 %.
REACH = 1.959964

Names = tuple[str, ...]
#: What a study says of the effects that were found: it shows them, excludes them at the size that
#: the others show, or cannot tell.
Says = Literal["shows", "excludes", "cannot tell"]


@dataclass(frozen=True)
class StudyPart:
    """Contribution of one study to the joint diagnosis.

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
    """The estimate of a parameter from one study alone, with its 95 % interval."""

    study: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Consistency:
    """Random-effects mean of a parameter over the studies that do not exclude the effect.

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
    """A set of effects, fitted to every study.

    evidence    ln likelihood less BIC's penalty, beyond the model without them, all studies
    delta_chi2  by which χ² falls, all studies
    """

    effects: tuple[str, ...]
    evidence: float
    delta_chi2: float


@dataclass(frozen=True)
class Together:
    """Result of a joint diagnosis: the verdict, and the effects that all studies share.

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


@dataclass(frozen=True, eq=False)
class Pooled:
    """The mean of values with known standard deviations, all in a fit's coordinates.

    reach    half of its 95 % interval
    spread   between the values beyond what each is uncertain by; Cochran's Q and its p-value
    without  (n,) the mean without each of them
    """

    mean: float
    reach: float
    spread: Spread
    without: FloatArray


def pool(values: FloatArray, std: FloatArray) -> Pooled:
    """Random-effects mean of (n,) values.

    source  variance between them by restricted maximum likelihood, see `Spread`; interval:
            Knapp & Hartung 2003, Statistics in Medicine 22, 2693, never narrower than by the
            standard deviations alone
    """
    spread = Spread.of(values, std)
    weights = 1.0 / (std**2 + spread.tau**2)
    mean = float(np.average(values, weights=weights))
    by_std = 1.0 / float(weights.sum())
    n = len(values)
    reach = REACH * np.sqrt(by_std)
    if n > 1:
        seen = float(np.sum(weights * (values - mean) ** 2)) / (n - 1)
        knapp = float(t_quantile(n - 1, 0.975)) * np.sqrt(by_std * seen)
        reach = max(reach, knapp)
    others = [
        float(np.average(np.delete(values, i), weights=np.delete(weights, i))) if n > 1 else mean
        for i in range(n)
    ]
    return Pooled(mean, float(reach), spread, np.array(others))


def check_names(names: Sequence[str]) -> None:
    """Raises ValueError: fewer than two studies, or two of one name."""
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(
            f"{', '.join(names)}: several studies of different names are needed; rename folders"
        )


def together(studies: Sequence[Examination]) -> Together:
    """The joint diagnosis of several studies whose cables may lack the same effects.

    raises  ValueError: of fewer than two studies, or of two of one name
    """
    check_names([s.fits.prepared.study.name for s in studies])
    rules = studies[0].fits.rules
    models_of: dict[Names, list[FittedModel]] = {}
    for names in _hypotheses(studies):
        models = [s.fits.with_effects(names) for s in studies]
        if all(models):
            models_of[names] = [m for m in models if m is not None]
    bases = [s.fits.base for s in studies]
    each = [
        Hypothesis(
            names,
            sum(m.evidence - base.evidence for base, m in zip(bases, models, strict=True)),
            sum(base.chi2 - m.chi2 for base, m in zip(bases, models, strict=True)),
        )
        for names, models in models_of.items()
    ]
    ranked = sorted(each, key=lambda h: -h.evidence)
    best = _simplest(ranked, studies, models_of)
    # one limit for the residuals of all studies together: each has its share of it
    rules = replace(rules, residual_significance=rules.residual_significance / len(studies))
    tied = tuple(
        h.effects
        for h in ranked
        if best.effects
        and h.effects != best.effects
        and len(h.effects) == len(best.effects)
        and h.delta_chi2 > best.delta_chi2 - rules.tie_delta_chi2
    )
    parts, consistency = _parts(studies, best, models_of[best.effects], rules)
    verdict, why = joint_verdict(best, tied, parts, rules)
    return Together(verdict, why, best.effects, tied, parts, consistency, tuple(ranked))


def _hypotheses(studies: Sequence[Examination]) -> list[Names]:
    """No effect; the sets that studies find, and what is tied; effects that all screens suggest."""
    votes: Counter[Names] = Counter()
    for study in studies:
        votes.update(_found(study))
    found = [names for names, _ in votes.most_common(MOST_SETS - BY_SCREENS)]
    likely = ranked_by_screens([s.fits.screened(s.fits.base) for s in studies])
    suggested = [(effect.name,) for effect in likely[:BY_SCREENS]]
    return list(dict.fromkeys([(), *found, *suggested]))


def _found(examination: Examination) -> Iterator[Names]:
    """The set of effects that a study finds, and the same with each effect tied with one of it."""
    diagnosis = examination.diagnosis
    listed = diagnosis.missing or diagnosis.partial
    names = tuple(sorted(one.effect for one in listed))
    if not names:
        added = examination.fits.added(examination.accepted)
        names = tuple(sorted(e.name for e in added))
    if names:
        yield names
    for one in listed:
        for other in one.tied_with:
            if other not in names:
                yield tuple(sorted({*names, other} - {one.effect}))


def _simplest(
    ranked: Sequence[Hypothesis],
    studies: Sequence[Examination],
    models_of: dict[Names, list[FittedModel]],
) -> Hypothesis:
    """The likeliest set, if it is significant; no effect where that leaves noise as well."""
    none = next(h for h in ranked if not h.effects)
    best = ranked[0]
    if not best.effects:
        return none
    count = sum(p.fitted for m in models_of[best.effects] for e in m.effects for p in e.parameters)
    count -= sum(p.fitted for s in studies for e in s.fits.base.effects for p in e.parameters)
    library = max(len(s.fits.library) for s in studies)
    p_value = library * float(chi2_sf(max(count, 1), max(best.delta_chi2, 0.0)))
    return best if p_value < studies[0].fits.rules.significance else none


def _parts(
    studies: Sequence[Examination],
    best: Hypothesis,
    models: Sequence[FittedModel],
    rules: Rules,
) -> tuple[tuple[StudyPart, ...], tuple[Consistency, ...]]:
    """Each study's part, and the parameters over those that do not exclude the effects."""
    evidence = [Evidence(s.fits.with_rules(rules), m) for s, m in zip(studies, models, strict=True)]
    shows = [_shows(s, m, best) for s, m in zip(studies, models, strict=True)]
    says: list[Says | Literal[""]] = ["" for _ in studies]
    if best.effects:
        says = _says(evidence, best, shows)
    parts = tuple(
        StudyPart(
            study.fits.prepared.study.name,
            study.diagnosis.verdict,
            tuple((m.effect, *m.tied_with) for m in study.diagnosis.missing),
            study.fits.base.chi2 - model.chi2,
            _explained(study, of_model, said),
            said,
        )
        for study, model, of_model, said in zip(studies, models, evidence, says, strict=True)
    )
    kept = [i for i, said in enumerate(says) if said != "excludes"]
    if not best.effects or not kept:
        return parts, ()
    some = [(studies[i].fits.prepared.study.name, evidence[i]) for i in kept]
    found = [_consistency(some, name) for name in _parameters(evidence[0], best)]
    return parts, tuple(found)


def _explained(study: Examination, with_effects: Evidence, said: str) -> bool:
    """Whether a study's model leaves noise; without the effects where it does not show them."""
    without = replace(with_effects, final=study.fits.base)
    return any(explains(e) for e in ([] if said == "shows" else [without]) + [with_effects])


def _shows(study: Examination, model: FittedModel, best: Hypothesis) -> bool:
    """Whether every effect is significant in a study by itself."""
    for effect in (e for e in model.effects if e.name in best.effects):
        rest = study.fits.fit_reduced(model, effect)
        if study.fits.gain(rest, model).p_value >= study.fits.rules.significance:
            return False
    return True


def _says(
    evidence: Sequence[Evidence], best: Hypothesis, shows: Sequence[bool]
) -> list[Says | Literal[""]]:
    """Of each study; one excludes the effects if its amplitude is far from that of the others."""
    said: list[Says | Literal[""]] = ["shows" if s else "cannot tell" for s in shows]
    if not any(shows):
        return said
    those = np.array(shows)
    for name in _parameters(evidence[0], best, amplitudes=True):
        q, std = _coordinates(evidence, name)
        mean = pool(q[those], std[those])
        for i in np.flatnonzero(~those):
            apart = abs(q[i] - mean.mean)
            if apart > 3.0 * np.hypot(std[i], mean.reach / REACH):
                said[i] = "excludes"
    return said


def _parameters(one: Evidence, best: Hypothesis, *, amplitudes: bool = False) -> list[str]:
    """Names of the fitted parameters of the effects found."""
    return [
        f"{e.name}.{p.name}"
        for e in one.estimate.fit.space.effects
        if e.name in best.effects
        for p in e.parameters
        if p.fitted and (p.amplitude or not amplitudes)
    ]


def _coordinates(evidence: Sequence[Evidence], name: str) -> tuple[FloatArray, FloatArray]:
    """(n,) a parameter in the fit's coordinate, and its standard deviation."""
    q, std = np.array([e.estimate.coordinate(name) for e in evidence]).T
    return q, std


def _consistency(studies: Sequence[tuple[str, Evidence]], name: str) -> Consistency:
    """One parameter over several studies."""
    evidence = [e for _, e in studies]
    q, std = _coordinates(evidence, name)
    found = pool(q, std)
    first = evidence[0].estimate
    space = first.fit.space
    i = space.names.index(name)
    reach = np.hypot(found.reach, REACH * first.model_error(name, found.mean))

    def natural(value: float) -> float:
        point = first.fit.q.copy()
        point[i] = np.clip(value, space.low[i], space.high[i])
        return float(space.natural(point)[i])

    return Consistency(
        name,
        space.units[i],
        bool(space.logarithmic[i]),
        natural(found.mean),
        natural(found.mean - reach),
        natural(found.mean + reach),
        found.spread.tau,
        found.spread.p_value,
        natural(float(found.without.min())),
        natural(float(found.without.max())),
        tuple(
            StudyValue(n, natural(v), natural(v - REACH * s), natural(v + REACH * s))
            for (n, _), v, s in zip(studies, q, std, strict=True)
        ),
    )


def joint_verdict(
    best: Hypothesis, tied: Sequence[Names], parts: Sequence[StudyPart], rules: Rules
) -> tuple[Verdict, str]:
    """The joint verdict of all studies, and its reason."""
    names = " and ".join(best.effects)
    left = [p.study for p in parts if not p.explained]
    if left:
        with_it = f" with {names}" if best.effects else ""
        rest = len(parts) - len(left)
        return "unexplained", (
            f"the model{with_it} leaves more than noise in {', '.join(left)}"
            f"{f', and noise in the {rest} others' if rest else ''}"
        )
    if not best.effects:
        unsure = [p.study for p in parts if p.alone == "cannot_tell"]
        if len(unsure) == len(parts):
            return "cannot_tell", "the model leaves noise in all studies, but none can tell"
        return "complete", f"the model leaves noise in all {len(parts)} studies"
    if len(tied) + 1 > rules.most_named:
        others = ", ".join(" and ".join(t) for t in tied)
        return "cannot_tell", f"{names} explains all studies, but so do {others}"
    shows = [p.study for p in parts if p.says == "shows"]
    excludes = [p.study for p in parts if p.says == "excludes"]
    confirmed = len(shows) > 1 or any(p.finds(best.effects) for p in parts)
    if not confirmed:
        return "cannot_tell", f"only {', '.join(shows) or 'all together'} shows {names}"
    if excludes:
        return "missing", (
            f"{names} is missing in {len(shows)} of {len(parts)} studies, {', '.join(shows)}; "
            f"{', '.join(excludes)} exclude it at that size: the cables are not alike"
        )
    silent = len(parts) - len(shows)
    also = f"; {silent} cannot tell and agree" if silent else ""
    return "missing", f"{len(shows)} of {len(parts)} studies show {names}{also}"
