"""What explains most of an error, not all; and the nearest effects, with what they leave.

Where no set of effects leaves noise, the model's own error is what an answer could be wrong by.  So
it is taken for the noise here, with its colour, and the model is fitted to all trials together:
which effect makes the largest difference to what is seen is asked, not what it would forecast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cell.cable.effects.base import Effect
from cell.cable.solver import Solver
from cell.identify.noise import Noise
from cell.lab.data.prepared import PreparedStudy, all_fitted
from cell.lab.data.results import Errors, Nearest, RemainingError
from cell.lab.search.explore import POLISHED, Candidate, Explorer
from cell.lab.statistics.score import holm
from cell.lab.verdict.doubts import at_bound, is_hopeless
from cell.lab.verdict.leftover import advantage, deviance, leftover, peak, removed_share
from cell.lab.verdict.rivals import added_effect, chance, chance_of, close_rivals
from cell.lab.verdict.rules import Rules

FloatArray = NDArray[np.float64]

#: Its error is far below what a model errs by that explains a study in part; it saves time.
COARSE = Solver(segments=20, step_s=1.5e-3)

#: All is weighed anew by the least error found if that is below this share of the one it was
#: weighed by, so often at most.
WEIGHED_ANEW = 0.5
MOST_WEIGHINGS = 3
#: Errors of what was not fitted to the fit trials alone.
NOT_FITTED = Errors(float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Partial:
    """Fits to all trials, weighed by the model's own error.

    explorer  with all trials to be fitted
    singles   each effect worth it alone beside the baseline
    steps     the baseline, then with each effect that removes most of what is left
    """

    explorer: Explorer
    singles: tuple[Candidate, ...]
    steps: tuple[Candidate, ...]


def explain_partly(
    explorer: Explorer, tried: Sequence[Candidate], library: int, rules: Rules
) -> Partial:
    """Explain most of a study that nothing explains to its noise.

    tried    candidates so far: what the best of them leaves is the model's own error
    library  number of effects to choose from
    """
    error, lowest = _own_error(explorer, tried), explorer.baseline()
    least_m = leftover(explorer.prepared, lowest).rms_m
    for _ in range(MOST_WEIGHINGS):
        whole = _weighed_by(explorer, error)
        if least_m < leftover(whole.prepared, whole.baseline()).rms_m:
            whole.rebase(
                lowest.fit.q, rules.tie
            )  # fitted to all trials a model leaves no more of them
        singles = _singles(whole, library, rules)
        base = whole.baseline()
        lowest, least_m = base, min(least_m, leftover(whole.prepared, base).rms_m)
        before, error = error, _own_error(whole, whole.known())
        # Fits that were stuck have an error that is no model's own; trials that weigh little are
        # fitted from anywhere.
        if error.std_m > WEIGHED_ANEW * before.std_m:
            break
    steps, options = [base], singles
    while True:
        better = largest_step(whole, steps[-1], options, library - len(steps) + 1, rules)
        if better is None:
            break
        steps.append(better)
        if len(steps) > rules.first_effects:
            break
        options = whole.add(better, whole.worth_refitting(better, rules.best))
    if len(steps) > 2:
        steps = _in_order(whole, base, _exchanged(whole, steps[-1], rules))
    steps = _borne_out(whole, steps, library, rules)
    if len(steps) == 2:
        for rival in _near(whole, steps[1], singles, rules):
            whole.add(rival, whole.worth_refitting(rival, rules.best))
    if is_hopeless(whole, steps[-1].fit):  # no model of the cable explains what it does
        steps = [base]
    return Partial(whole, tuple(singles), tuple(steps))


def _singles(whole: Explorer, library: int, rules: Rules) -> list[Candidate]:
    """Each effect worth it alone beside the baseline, taken to convergence.

    One explains only what the same model without it does not, wherever its search began: the
    baseline is fitted from where the best one ended too.
    """
    singles: list[Candidate] = []
    for _ in range(MOST_WEIGHINGS):
        base = whole.baseline()
        singles = _finished(whole, base, whole.add(base, whole.worth_refitting(base, rules.best)))
        best = largest_step(whole, base, singles, library, rules)
        if best is None or not whole.rebase(_without_effect(base, best), rules.tie):
            break
    return singles


def _borne_out(
    explorer: Explorer, steps: Sequence[Candidate], library: int, rules: Rules
) -> list[Candidate]:
    """The steps up to the first whose effect explains nothing significant beside those before.

    Of two effects found together, exchanged and put in order, one may need no other.
    """
    kept = list(steps[:1])
    for small, large in pairwise(steps):
        if p_value_of(explorer, small, large, library) >= rules.significance:
            break
        kept.append(large)
    return kept


def p_value_of(explorer: Explorer, small: Candidate, large: Candidate, library: int) -> float:
    """Of the last effect of `large`, for all of the library: by the fit, and by what both leave."""
    by_fit = explorer.gain(small, large).p_value
    by_left = chance_of(explorer, small, large)
    return min(1.0, max(by_fit, by_left) * max(1, library - len(small.effects)))


def _without_effect(base: Candidate, candidate: Candidate) -> FloatArray:
    """Coordinates of a candidate that the baseline has too."""
    names = candidate.fit.space.names
    return candidate.fit.q[[names.index(name) for name in base.fit.space.names]]


def _finished(explorer: Explorer, base: Candidate, singles: Sequence[Candidate]) -> list[Candidate]:
    """All singles taken to convergence: how much each leaves is compared and told."""
    pending = [added_effect(base, c) for c in singles if not c.fit.solution.converged]
    finished: dict[frozenset[str], Candidate] = {}
    for first in range(0, len(pending), POLISHED):  # it takes only so many to convergence at once
        few = explorer.add(base, pending[first : first + POLISHED])
        finished |= {c.names: c for c in few}
    return [finished.get(c.names, c) for c in singles]


def _near(
    explorer: Explorer, final: Candidate, singles: Sequence[Candidate], rules: Rules
) -> list[Candidate]:
    """The nearest other single effects, where `final`, itself one, leaves more than noise.

    Something is missing beside each of them then, as beside `final`.
    """
    prepared = explorer.prepared
    left = {c.names: leftover(prepared, c).mean_square_m2 for c in singles}
    if left[final.names] < (rules.gross_misfit * prepared.floor.noise.std_m) ** 2:
        return []
    by_left = sorted(singles, key=lambda c: left[c.names])[: rules.nearest]
    return [c for c in by_left if c.names != final.names]


def _weighed_by(explorer: Explorer, error: Noise) -> Explorer:
    """An explorer of all trials together, with a model's own error for noise."""
    weighed = PreparedStudy.of(
        all_fitted(explorer.prepared.measured),
        misfit=error,
        solver=COARSE,
        work=explorer.prepared.work,
    )
    weighed = replace(weighed, floor=explorer.prepared.floor)
    return Explorer(weighed, explorer.space, explorer.library, explorer.progress, explorer.prior_q)


def _exchanged(explorer: Explorer, final: Candidate, rules: Rules) -> Candidate:
    """The candidate with effects found before the last exchanged for what leaves less.

    What was found first was found without the others, and may have stood in for one of them; what
    leaves as little in its place is fitted here, and so is known for a tie.
    """
    prepared, exchanged = explorer.prepared, True
    tried: set[frozenset[str]] = set()
    while exchanged and prepared.work.simulated_s < rules.most_simulated_s:
        exchanged = False
        for effect in [e for e in final.effects if e not in explorer.space.effects]:
            rest = explorer.without(final, effect)
            if rest.names in tried:
                continue
            tried.add(rest.names)
            rivals = explorer.add(rest, explorer.worth_refitting(rest, rules.best))
            left = [leftover(prepared, c).mean_square_m2 for c in rivals]
            sound = [i for i, c in enumerate(rivals) if not _at_bound(rest, c)]
            best = min(sound, key=lambda i: left[i], default=None)
            if best is not None and left[best] < leftover(prepared, final).mean_square_m2:
                final, exchanged = rivals[best], True
                break
    return final


def _in_order(explorer: Explorer, base: Candidate, final: Candidate) -> list[Candidate]:
    """From the baseline to `final`, each time without the effect that the rest needs least."""
    steps = [final]
    while len(steps[0].names) > len(base.names) + 1:
        added = [e for e in steps[0].effects if e.name not in base.names]
        smaller = [explorer.without(steps[0], e) for e in added]
        least = min(smaller, key=lambda c: leftover(explorer.prepared, c).mean_square_m2)
        steps.insert(0, least)
    return [base, *steps]


def _at_bound(small: Candidate, large: Candidate) -> bool:
    """Whether the effect that `large` has more is as strong as its bound lets it be."""
    own = f"{added_effect(small, large).name}."
    return any(name.startswith(own) for name, *_ in at_bound(large.fit))


def _any_at_bound(candidate: Candidate) -> bool:
    """Whether any effect of a candidate is as strong as its bound lets it be."""
    own = tuple(f"{name}." for name in candidate.names)
    return any(name.startswith(own) for name, *_ in at_bound(candidate.fit))


def _own_error(explorer: Explorer, tried: Sequence[Candidate]) -> Noise:
    """The least error so far on the fit trials, as noise of independent frames."""
    fitted = [replace(c, heldout=None) for c in tried]
    left = min((leftover(explorer.prepared, c) for c in fitted), key=lambda e: e.mean_square_m2)
    count = sum(explorer.prepared.whiteners[t.name].count for t in explorer.fitted_trials())
    return Noise(left.rms_m * float(np.sqrt(max(1.0, count / left.independent))))


def largest_step(
    explorer: Explorer,
    current: Candidate,
    options: Sequence[Candidate],
    library: int,
    rules: Rules,
) -> Candidate | None:
    """The option that leaves least, if it removes most of the error, significantly.

    What is at its bound is none: the limit has given that answer, not the measurement.
    """
    options = [c for c in options if not _at_bound(current, c)]
    if not options:
        return None
    prepared = explorer.prepared
    before = leftover(prepared, current)
    left = [leftover(prepared, c) for c in options]
    chances = [chance(current, c, before, a) for c, a in zip(options, left, strict=True)]
    adjusted = holm(chances + [1.0] * max(0, library - len(chances)))
    best = int(np.argmin([a.mean_square_m2 for a in left]))
    share = removed_share(prepared.floor.noise.std_m, before, left[best])
    by_fit = explorer.gain(current, options[best]).p_value * library
    sound = max(adjusted[best], by_fit) < rules.significance and share > rules.most_share
    return options[best] if sound else None


def tied_so_far(
    explorer: Explorer, final: Candidate, effect: type[Effect], rules: Rules
) -> tuple[str, ...]:
    """Effects that leave as little in place of `effect`, of the sets of effects fitted already.

    Of a single effect that leaves more than noise also those that do with one more beside them:
    more than one is missing then, and what is nearest alone need not be one of these.
    """
    rest = final.names - {effect.name}
    rivals = [
        c
        for c in explorer.known()
        if rest < c.names and len(c.names) == len(final.names) and c.names != final.names
    ]
    small = next((c for c in explorer.known() if c.names == rest), explorer.baseline())
    close = _as_good(explorer, small, final, rivals, rules)
    tied = [next(iter(c.names - rest)) for c in close]
    near = [] if rest else _near(explorer, final, [final, *rivals], rules)
    most = leftover(explorer.prepared, final)
    for alone in near:
        name = next(iter(alone.names))
        in_company = [
            c
            for c in explorer.known()
            if alone.names < c.names and effect.name not in c.names and not _any_at_bound(c)
        ]
        left = [leftover(explorer.prepared, c) for c in in_company]
        if name not in tied and any(deviance(most, x) <= 0.0 for x in left):
            tied.append(name)
    return tuple(tied)


def _as_good(
    explorer: Explorer,
    small: Candidate,
    final: Candidate,
    rivals: Sequence[Candidate],
    rules: Rules,
) -> list[Candidate]:
    """Rivals that leave as little as `final`, by what models that are all wrong can tell.

    What is at its bound is none, nor is what removes nothing significant, or not most of what
    `final` does, of the error of `small`, which lacks the last effect.
    """
    prepared = explorer.prepared
    noise_m = prepared.floor.noise.std_m
    before, most = leftover(prepared, small), leftover(prepared, final)
    least = rules.most_share * removed_share(noise_m, before, most)
    close = {c.names for c in close_rivals(explorer, final, rivals, rules)}
    found = []
    for rival in rivals:
        left = leftover(prepared, rival)
        p_value = chance(small, rival, before, left) * len(explorer.library)
        if _at_bound(small, rival) or p_value > rules.significance:
            continue
        if removed_share(noise_m, before, left) < least:
            continue
        if rival.names in close or advantage(prepared, final, rival) < rules.advantage:
            found.append(rival)
    return sorted(found, key=lambda c: c.chi2)


def nearest(partial: Partial, tried: Sequence[Candidate], rules: Rules) -> tuple[Nearest, ...]:
    """The single effects that leave least of all trials together, how much, and where.

    tried  the same fitted to the fit trials alone: their errors are what a forecast would have
    """
    prepared = partial.explorer.prepared
    base = partial.steps[0]
    before = leftover(prepared, base)
    best = sorted(
        ((leftover(prepared, c), c) for c in partial.singles),
        key=lambda pair: pair[0].mean_square_m2,
    )
    strict = {c.names: c for c in tried}
    return tuple(
        Nearest(
            effect=added_effect(base, candidate).name,
            explained_share=removed_share(prepared.floor.noise.std_m, before, after),
            left_rms_m=after.rms_m,
            errors=strict[candidate.names].errors if candidate.names in strict else NOT_FITTED,
            peak=peak(prepared, candidate),
        )
        for after, candidate in best[: rules.nearest]
    )


def what_is_left(explorer: Explorer, base: Candidate, final: Candidate) -> RemainingError:
    """How much a candidate leaves, of what the baseline missed, and where."""
    prepared = explorer.prepared
    noise_m = prepared.floor.noise.std_m
    before, after = leftover(prepared, base), leftover(prepared, final)
    return RemainingError(
        rms_m=after.rms_m,
        before_rms_m=before.rms_m,
        over_noise=after.rms_m / noise_m,
        explained_share=removed_share(noise_m, before, after),
        peak=peak(prepared, final),
    )
