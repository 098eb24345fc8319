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
from cell.lab.data.rules import Rules
from cell.lab.fit.shared import Spread
from cell.lab.line.cables_space import ranked_by_screens
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.checks import explains
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.evidence import Evidence

#: Number of sets of effects fitted to all studies, and of those proposed by the sum of the screens.
MOST_SETS, BY_SCREENS = 8, 2
#: Half-width of a 95 % interval, in standard deviations.
REACH = 1.959964

Names = tuple[str, ...]
#: Evidence of a study on the effects found: it shows them, excludes them at the size in the others,
#: or cannot tell.
Says = Literal["shows", "excludes", "cannot tell"]


@dataclass(frozen=True)
class StudyPart:
    """Contribution of one study to the joint diagnosis.

    alone         verdict of the study alone
    missing       effects missing in its own diagnosis, each with those tied with it
    delta_chi2    fall of χ² over all its trials by the effects of the joint result
    explained     whether its residual is noise with these effects, or without them where the study
                  does not show them
    says          evidence on these effects; "" if there are none
    """

    study: str
    alone: Verdict
    missing: tuple[tuple[str, ...], ...]
    delta_chi2: float
    explained: bool
    says: Says | Literal[""]

    def finds(self, effects: Sequence[str]) -> bool:
        """Whether each of these effects, or one tied with it, is missing in its own diagnosis.

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
    q_p_value            of the spread of the values (Cochran's Q)
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

    why         reason of the verdict, as a sentence
    effects     missing in the model; empty if none is
    tied        sets of effects that explain as much
    hypotheses  all fitted sets, the likeliest first
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
    spread   between the values in excess of their uncertainties; Cochran's Q and its p-value
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
        scatter = float(np.sum(weights * (values - mean) ** 2)) / (n - 1)
        knapp = float(t_quantile(n - 1, 0.975)) * np.sqrt(by_std * scatter)
        reach = max(reach, knapp)
    without = [
        float(np.average(np.delete(values, i), weights=np.delete(weights, i))) if n > 1 else mean
        for i in range(n)
    ]
    return Pooled(mean, float(reach), spread, np.array(without))


def check_names(names: Sequence[str]) -> None:
    """Raises ValueError: fewer than two studies, or two with the same name."""
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(
            f"{', '.join(names)}: several studies of different names are needed; rename folders"
        )


def together(studies: Sequence[Examination]) -> Together:
    """The joint diagnosis of several studies whose cables may lack the same effects.

    raises  ValueError: fewer than two studies, or two with the same name
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
    # Bonferroni: the residuals of all studies share one significance level
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
    """No effect; the sets that single studies propose, with ties; the best of all screens."""
    votes: Counter[Names] = Counter()
    for study in studies:
        votes.update(_proposed(study))
    proposed = [names for names, _ in votes.most_common(MOST_SETS - BY_SCREENS)]
    likely = ranked_by_screens([s.fits.screened(s.fits.base) for s in studies])
    suggested = [(effect.name,) for effect in likely[:BY_SCREENS]]
    return list(dict.fromkeys([(), *proposed, *suggested]))


def _proposed(examination: Examination) -> Iterator[Names]:
    """Yield the set of effects of a study's diagnosis, and the variants by its ties."""
    diagnosis = examination.diagnosis
    listed = diagnosis.missing or diagnosis.partial
    names = tuple(sorted(effect.effect for effect in listed))
    if not names:
        added = examination.fits.added(examination.accepted)
        names = tuple(sorted(e.name for e in added))
    if names:
        yield names
    for effect in listed:
        for rival in effect.tied_with:
            if rival not in names:
                yield tuple(sorted({*names, rival} - {effect.effect}))


def _simplest(
    ranked: Sequence[Hypothesis],
    studies: Sequence[Examination],
    models_of: dict[Names, list[FittedModel]],
) -> Hypothesis:
    """The likeliest set, if it is significant; else the hypothesis without effects."""
    baseline = next(h for h in ranked if not h.effects)
    best = ranked[0]
    if not best.effects:
        return baseline
    count = sum(p.fitted for m in models_of[best.effects] for e in m.effects for p in e.parameters)
    count -= sum(p.fitted for s in studies for e in s.fits.base.effects for p in e.parameters)
    library = max(len(s.fits.library) for s in studies)
    p_value = library * float(chi2_sf(max(count, 1), max(best.delta_chi2, 0.0)))
    return best if p_value < studies[0].fits.rules.significance else baseline


def _parts(
    studies: Sequence[Examination],
    best: Hypothesis,
    models: Sequence[FittedModel],
    rules: Rules,
) -> tuple[tuple[StudyPart, ...], tuple[Consistency, ...]]:
    """Each study's part, and consistency of the parameters where effects are not excluded."""
    evidence = [Evidence(s.fits.with_rules(rules), m) for s, m in zip(studies, models, strict=True)]
    says: list[Says | Literal[""]] = ["" for _ in studies]
    if best.effects:
        says = _evidence_of_studies(evidence, best)
    parts = tuple(
        StudyPart(
            study.fits.prepared.study.name,
            study.diagnosis.verdict,
            tuple((m.effect, *m.tied_with) for m in study.diagnosis.missing),
            study.fits.base.chi2 - model.chi2,
            _explained(study, of_model, text),
            text,
        )
        for study, model, of_model, text in zip(studies, models, evidence, says, strict=True)
    )
    included = [i for i, text in enumerate(says) if text != "excludes"]
    if not best.effects or not included:
        return parts, ()
    named = [(studies[i].fits.prepared.study.name, evidence[i]) for i in included]
    consistency = [_consistency(named, name) for name in _parameters(evidence[0], best)]
    return parts, tuple(consistency)


def _explained(study: Examination, with_effects: Evidence, says: str) -> bool:
    """Whether a study's residual is noise, with the effects or, if not shown, without them."""
    without = replace(with_effects, final=study.fits.base)
    return any(explains(e) for e in ([] if says == "shows" else [without]) + [with_effects])


def _shows(evidence: Evidence, best: Hypothesis) -> bool:
    """Whether every effect is significant in a study by itself."""
    fits, model = evidence.fits, evidence.final
    return all(
        fits.gain(fits.fit_reduced(model, effect), model).p_value < fits.rules.significance
        for effect in model.effects
        if effect.name in best.effects
    )


def _evidence_of_studies(
    evidence: Sequence[Evidence], best: Hypothesis
) -> list[Says | Literal[""]]:
    """Evidence per study; it excludes the effects if its amplitude is far from the others'."""
    showing = np.array([_shows(e, best) for e in evidence])
    says: list[Says | Literal[""]] = ["shows" if shows else "cannot tell" for shows in showing]
    if not showing.any():
        return says
    for name in _parameters(evidence[0], best, amplitudes=True):
        q, std = _coordinates(evidence, name)
        mean = pool(q[showing], std[showing])
        for i in np.flatnonzero(~showing):
            difference = abs(q[i] - mean.mean)
            if difference > 3.0 * np.hypot(std[i], mean.reach / REACH):
                says[i] = "excludes"
    return says


def _parameters(evidence: Evidence, best: Hypothesis, *, amplitudes: bool = False) -> list[str]:
    """Names of the fitted parameters of the effects of a hypothesis."""
    return [
        f"{e.name}.{p.name}"
        for e in evidence.estimate.fit.space.effects
        if e.name in best.effects
        for p in e.parameters
        if p.fitted and (p.amplitude or not amplitudes)
    ]


def _coordinates(evidence: Sequence[Evidence], name: str) -> tuple[FloatArray, FloatArray]:
    """(n,) coordinate of a parameter per study, and its standard deviation."""
    q, std = np.array([e.estimate.coordinate(name) for e in evidence]).T
    return q, std


def _consistency(studies: Sequence[tuple[str, Evidence]], name: str) -> Consistency:
    """Consistency of one parameter over several studies."""
    evidence = [e for _, e in studies]
    q, std = _coordinates(evidence, name)
    pooled = pool(q, std)
    first = evidence[0].estimate
    space = first.fit.space
    i = space.names.index(name)
    reach = np.hypot(pooled.reach, REACH * first.model_error(name, pooled.mean))

    def natural(value: float) -> float:
        point = first.fit.q.copy()
        point[i] = np.clip(value, space.low[i], space.high[i])
        return float(space.natural(point)[i])

    return Consistency(
        name,
        space.units[i],
        bool(space.logarithmic[i]),
        natural(pooled.mean),
        natural(pooled.mean - reach),
        natural(pooled.mean + reach),
        pooled.spread.tau,
        pooled.spread.p_value,
        natural(float(pooled.without.min())),
        natural(float(pooled.without.max())),
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
    unexplained = [p.study for p in parts if not p.explained]
    if unexplained:
        with_it = f" with {names}" if best.effects else ""
        explained_count = len(parts) - len(unexplained)
        return "unexplained", (
            f"the model{with_it} leaves more than noise in {', '.join(unexplained)}"
            f"{f', and noise in the {explained_count} others' if explained_count else ''}"
        )
    if not best.effects:
        unsure = [p.study for p in parts if p.alone == "cannot_tell"]
        if len(unsure) == len(parts):
            return "cannot_tell", "the model leaves noise in all studies, but none can tell"
        return "complete", f"the model leaves noise in all {len(parts)} studies"
    if len(tied) + 1 > rules.most_named:
        rivals = ", ".join(" and ".join(t) for t in tied)
        return "cannot_tell", f"{names} explains all studies, but so do {rivals}"
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
    agreement = f"; {silent} cannot tell and agree" if silent else ""
    return "missing", f"{len(shows)} of {len(parts)} studies show {names}{agreement}"
