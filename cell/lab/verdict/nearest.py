"""Effects that come nearest to explaining a study, and what they leave."""

from __future__ import annotations

from collections.abc import Sequence

from cell.cable.effects.base import Effect
from cell.lab.data.results import Errors, Nearest, RemainingError
from cell.lab.data.thresholds import Rules
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.fit_doubts import at_bound
from cell.lab.verdict.partial import Partial
from cell.lab.verdict.residual_summary import (
    log_variance_ratio,
    peak,
    removed_share,
    residual_summary,
    vuong_z,
)
from cell.lab.verdict.rivals import (
    added_effect,
    any_at_bound,
    chance,
    close_rivals,
    is_at_bound,
    near_singles,
)

#: Errors of what was not fitted to the fit trials alone.
NOT_FITTED = Errors(float("nan"), float("nan"))


def tied_so_far(
    fits: FitCache, final: FittedModel, effect: type[Effect], rules: Rules
) -> tuple[str, ...]:
    """Effects that leave as little in place of `effect`, of the sets of effects fitted already.

    Of a single effect that leaves more than noise also those that do with one more beside them:
    more than one is missing then, and what is nearest alone need not be one of these.
    """
    rest = final.names - {effect.name}
    rivals = [
        c
        for c in fits.known()
        if rest < c.names and len(c.names) == len(final.names) and c.names != final.names
    ]
    small = next((c for c in fits.known() if c.names == rest), fits.baseline())
    close = _as_good(fits, small, final, rivals, rules)
    tied = [next(iter(c.names - rest)) for c in close]
    near = [] if rest else near_singles(fits, final, [final, *rivals], rules)
    most = residual_summary(fits.prepared, final)
    for alone in near:
        name = next(iter(alone.names))
        in_company = [
            c
            for c in fits.known()
            if alone.names < c.names and effect.name not in c.names and not any_at_bound(c)
        ]
        left = [residual_summary(fits.prepared, c) for c in in_company]
        if name not in tied and any(log_variance_ratio(most, x) <= 0.0 for x in left):
            tied.append(name)
    return tuple(tied)


def _as_good(
    fits: FitCache,
    small: FittedModel,
    final: FittedModel,
    rivals: Sequence[FittedModel],
    rules: Rules,
) -> list[FittedModel]:
    """Rivals that leave as little as `final`, by what models that are all wrong can tell.

    What is at its bound is none, nor is what removes nothing significant, or not most of what
    `final` does, of the error of `small`, which lacks the last effect.
    """
    prepared = fits.prepared
    noise_m = prepared.noise_model.noise.std_m
    before, most = residual_summary(prepared, small), residual_summary(prepared, final)
    least = rules.most_share * removed_share(noise_m, before, most)
    close = {c.names for c in close_rivals(fits, final, rivals, rules)}
    found = []
    for rival in rivals:
        left = residual_summary(prepared, rival)
        p_value = chance(small, rival, before, left) * len(fits.library)
        if is_at_bound(small, rival) or p_value > rules.significance:
            continue
        if removed_share(noise_m, before, left) < least:
            continue
        if rival.names in close or vuong_z(prepared, final, rival) < rules.vuong_z:
            found.append(rival)
    return sorted(found, key=lambda c: c.chi2)


def nearest(partial: Partial, tried: Sequence[FittedModel], rules: Rules) -> tuple[Nearest, ...]:
    """The single effects that leave least of all trials together, how much, and where.

    tried  the same fitted to the fit trials alone: their errors are what a forecast would have
    """
    prepared = partial.fits.prepared
    base = partial.steps[0]
    before = residual_summary(prepared, base)
    best = sorted(
        ((residual_summary(prepared, c), c) for c in partial.singles),
        key=lambda pair: pair[0].mean_square_m2,
    )
    strict = {c.names: c for c in tried}
    return tuple(
        Nearest(
            effect=added_effect(base, candidate).name,
            explained_share=removed_share(prepared.noise_model.noise.std_m, before, after),
            left_rms_m=after.rms_m,
            errors=strict[candidate.names].errors if candidate.names in strict else NOT_FITTED,
            peak=peak(prepared, candidate),
            at_bound=_at_bound(candidate, added_effect(base, candidate).name),
        )
        for after, candidate in best[: rules.most_named]
    )


def _at_bound(candidate: FittedModel, effect: str) -> tuple[str, ...]:
    """Parameters of an effect that are at a bound, with their values."""
    return tuple(
        f"{name} {value:.3g} {unit}"
        for name, value, unit in at_bound(candidate.fit)
        if name.startswith(f"{effect}.")
    )


def what_is_left(fits: FitCache, base: FittedModel, final: FittedModel) -> RemainingError:
    """How much a candidate leaves, of what the baseline missed, and where."""
    prepared = fits.prepared
    noise_m = prepared.noise_model.noise.std_m
    before, after = residual_summary(prepared, base), residual_summary(prepared, final)
    return RemainingError(
        rms_m=after.rms_m,
        before_rms_m=before.rms_m,
        over_noise=after.rms_m / noise_m,
        explained_share=removed_share(noise_m, before, after),
        peak=peak(prepared, final),
    )
