"""Ties: effects that fit as well as an added one, in its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cell.cable.effects.base import Effect
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import (
    FittedModel,
    log_variance_ratio,
    residual_summary,
    vuong_z,
)
from cell.lab.search.partial import any_at_bound, close_rivals, is_at_bound, near_singles, step_p
from cell.lab.verdict.checks import explains
from cell.lab.verdict.evidence import Evidence


def with_ties(evidence: Evidence) -> Evidence:
    """The evidence with the ties of each added effect; effects with too many ties are dropped.

    An effect is dropped only if it is not the only one, and the others explain the study without
    it: an effect that many others could replace is not identified.
    """
    fits, added = evidence.fits, evidence.added
    for effect in added:
        if (simpler := _special_case(fits, evidence.final, effect)) is not None:
            return with_ties(replace(evidence, final=simpler))
    tied = {e.name: _tied(fits, evidence.final, e) for e in added}
    for effect in added if len(added) > 1 else ():
        if len(tied[effect.name]) + 1 > evidence.rules.most_named:
            rest = replace(evidence, final=fits.fit_reduced(evidence.final, effect))
            if explains(rest):
                return with_ties(rest)
    return replace(evidence, tied=tied)


def _special_case(fits: FitCache, final: FittedModel, effect: type[Effect]) -> FittedModel | None:
    """The model with a special case in place of `effect`, if that explains as much; None if not."""
    if not any(e.wider is effect for e in fits.library.values()):
        return None
    rivals = fits.extended(fits.fit_reduced(final, effect))
    special = [c for c in rivals if any(e.wider is effect for e in c.effects)]
    close = close_rivals(fits, final, special)
    return close[0] if close else None


def _tied(fits: FitCache, final: FittedModel, effect: type[Effect]) -> tuple[str, ...]:
    """Effects that explain as much in place of `effect`, all trials together.

    The wider law of which it is a special case is no other explanation.
    """
    rest = fits.fit_reduced(final, effect)
    rivals = fits.extended(rest)
    close = close_rivals(fits, final, rivals)
    names = [next(iter(c.names - rest.names)) for c in close]
    own = "" if effect.wider is None else effect.wider.name
    return tuple(name for name in names if name not in final.names and name != own)


def tied_so_far(fits: FitCache, final: FittedModel, effect: type[Effect]) -> tuple[str, ...]:
    """Effects that tie with `effect`, among the models fitted so far.

    For a single effect with a residual above noise, also effects that tie after one more is added:
    more than one is missing then, and the single nearest effect need not be one of them.
    """
    without = final.names - {effect.name}
    rivals = [
        c
        for c in fits.known()
        if without < c.names
        and len(c.names) == len(final.names)
        and c.names != final.names
        and not any(e is effect.wider for e in c.effects)
    ]
    small = next((c for c in fits.known() if c.names == without), fits.base)
    close = _as_good(fits, small, final, rivals)
    tied = [next(iter(c.names - without)) for c in close]
    near = [] if without else near_singles(fits, final, [final, *rivals])
    own = residual_summary(fits.prepared, final)
    for rival in near:
        name = next(iter(rival.names))
        with_one_more = [
            c
            for c in fits.known()
            if rival.names < c.names and effect.name not in c.names and not any_at_bound(c)
        ]
        residuals = [residual_summary(fits.prepared, c) for c in with_one_more]
        if name not in tied and any(log_variance_ratio(own, x) <= 0.0 for x in residuals):
            tied.append(name)
    return tuple(tied)


def _as_good(
    fits: FitCache, small: FittedModel, final: FittedModel, rivals: Sequence[FittedModel]
) -> list[FittedModel]:
    """Rivals that explain as much as `final`, by a test for models that are all wrong (Vuong).

    Excluded are rivals at a bound, and those that remove no significant part, or not most of what
    `final` removes, of the error of `small`, which lacks the last effect.
    """
    rules, close = fits.rules, {c.names for c in close_rivals(fits, final, rivals)}
    least = rules.most_share * fits.removed_share(small, final)

    def as_good(rival: FittedModel) -> bool:
        p_value = step_p(fits, small, rival) * len(fits.library)
        if is_at_bound(small, rival) or p_value > rules.significance:
            return False
        if fits.removed_share(small, rival) < least:
            return False
        return rival.names in close or vuong_z(fits.prepared, final, rival) < rules.vuong_z

    return sorted(filter(as_good, rivals), key=lambda c: c.chi2)
