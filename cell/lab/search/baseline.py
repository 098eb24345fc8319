"""The baseline fitted to a study, and the estimates of noise and mesh error that depend on it."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy, with_noise_from
from cell.lab.data.rules import DEFAULT_RULES, Rules
from cell.lab.data.work import Progress, no_progress
from cell.lab.fit.corrections import corrected, with_conditional_noise, with_gain_of
from cell.lab.fit.fitting import Fit, errors_m, fit_model, fit_trials, space_with, with_slope_solver
from cell.lab.fit.score_test import screen
from cell.lab.fit.sensitivity import is_shape
from cell.lab.search.extension import MOST_GUESSES, TEMPER, cold_start
from cell.lab.search.fitted_model import POLISH, REFIT, FittedModel, error_text

#: Above this χ² per value the baseline cannot fit, and a tempered fit is a better start.
MISFIT = 1.5


@dataclass(frozen=True, eq=False)
class SearchSetup:
    """Inputs of a search for effects; `FitCache.of` fits its baseline.

    prepared         the study with the noise from its frames at rest
    space            parameters of the baseline, with those of its effects
    library          effects that may be added, by name
    prior_q          (p,) coordinates of an earlier individual's model; None = there is none
    start_q          (p,) where the baseline's fit starts; None = a start is searched
    unknown_effects  effects of `space` without start values: they are added one by one, as if the
                     model lacked them, where a fit from their typical size leaves more than noise
    reference        model given which noise and mesh error were re-estimated; None = they were not
    earlier          models of an earlier search by their effects: where fits start
    rules            limits for accepting an effect
    """

    prepared: PreparedStudy
    space: ParameterSpace
    library: Mapping[str, type[Effect]]
    progress: Progress = no_progress
    prior_q: FloatArray | None = None
    start_q: FloatArray | None = None
    unknown_effects: tuple[type[Effect], ...] = ()
    reference: FittedModel | None = None
    earlier: Mapping[frozenset[str], FittedModel] = field(default_factory=dict)
    rules: Rules = DEFAULT_RULES


@dataclass(frozen=True, eq=False)
class BaselineFit:
    """The fitted baseline.

    prepared   the study with noise and mesh error estimated given the baseline
    tempered   the fit with residuals scaled down, where the baseline cannot fit
    second     the fit from another start, if one was tried
    """

    prepared: PreparedStudy
    fit: Fit
    tempered: Fit | None = None
    second: Fit | None = None


def fit_baseline(
    setup: SearchSetup, by_adding: Callable[[PreparedStudy], Fit | None] | None = None
) -> BaselineFit:
    """The baseline with noise and mesh error estimated given it.

    by_adding  its fit from the end of a search that adds the unknown effects one by one; None if
               there are none
    raises     UnsimulatedError
    """
    prepared, space, progress = setup.prepared, setup.space, setup.progress
    names = ", ".join(e.name for e in space.effects) or "no effects"
    progress(f"looking where to begin with {names}", 0, 3)
    start = setup.start_q
    if start is None:
        start = cold_start(prepared, space)
        if setup.prior_q is None:  # else the shapes are the earlier individual's
            start = _of_likeliest_shape(setup, prepared, _scanned(setup, prepared, start))
    progress(f"fitting the model with {names}", 1, 3)
    fit = fit_model(prepared, space, start, options=POLISH)
    calibrated = with_gain_of(prepared, fit)
    if calibrated is not prepared:
        prepared, start = calibrated, fit.q
        fit = fit_model(prepared, space, start, options=POLISH)
    whitened = with_noise_from(prepared, errors_m(prepared, fit))
    if whitened is not prepared:
        fit = fit_model(whitened, space, start, options=POLISH)
    result = _with_noise_and_mesh_error(setup, BaselineFit(whitened, fit))
    error = error_text(result.prepared, result.fit.rms_m)
    progress(f"weighing the model with {names}, {error}", 2, 3)
    expected_m = result.prepared.expected_m("fit")
    prepared.work.note_fit((e.name for e in space.effects), result.fit.rms_m, expected_m)
    count = result.prepared.count(fit_trials(result.prepared))
    misfit = result.fit.rms_m > ERROR_RATIO * expected_m
    far = result.fit.chi2 > MISFIT * count or (by_adding is not None and misfit)
    if far and prepared.work.affords(f"other starts of the model with {names}"):
        best = _multistart(setup, result, start, count, by_adding)
        if by_adding is not None and best.fit is not result.fit:
            # re-estimate the noise given this model
            best = _with_noise_and_mesh_error(setup, best)
        result = best
    prepared, fit = with_slope_solver(result.prepared, result.fit)
    return replace(result, prepared=prepared, fit=fit)


def _with_noise_and_mesh_error(setup: SearchSetup, before: BaselineFit) -> BaselineFit:
    """The fit with the noise of all frames given it, within the range from frames at rest.

    If it explains the study, mesh errors and those of rounded values are corrected too.  The
    unchanged fit where it cannot be simulated again.
    """
    if setup.reference is not None:
        return before
    space, library = setup.space, setup.library
    further = [e for name, e in library.items() if name not in {x.name for x in space.effects}]
    fit, prepared = before.fit, with_conditional_noise(before.prepared, before.fit, further)
    if fit.rms_m <= ERROR_RATIO * prepared.expected_m("fit"):
        prepared = corrected(prepared, fit)
    try:
        refitted = fit_model(prepared, space, fit.q, fit.initial_states, options=POLISH)
    except UNSIMULATED:
        return before
    return replace(before, prepared=prepared, fit=refitted)


def _multistart(
    setup: SearchSetup,
    first: BaselineFit,
    start: FloatArray,
    count: int,
    by_adding: Callable[[PreparedStudy], Fit | None] | None,
) -> BaselineFit:
    """The best fit from several starts, and the second best, of a baseline that cannot fit.

    EI(s) absorbs what a model lacks; the prior keeps a tempered fit plausible.
    """
    fits, prepared = [first.fit], first.prepared
    scale = TEMPER * float(np.sqrt(first.fit.chi2 / count))
    added = None if by_adding is None else by_adding(prepared)
    if added is not None:
        fits = sorted([first.fit, added], key=lambda f: f.objective)
    tempered = fit_model(prepared, setup.space, start, residual_scale=scale, options=REFIT)
    if not fits[0].solution.converged:
        with contextlib.suppress(*UNSIMULATED):  # its end may not be simulable
            fits.append(fit_model(prepared, setup.space, tempered.q, options=POLISH))
    best, *worse = sorted(fits, key=lambda f: f.objective)
    return BaselineFit(prepared, best, tempered, worse[0] if worse else None)


def _scanned(setup: SearchSetup, prepared: PreparedStudy, start: FloatArray) -> FloatArray:
    """A start with narrow effects, which a fit reaches only from near, from a screen."""
    space = setup.space
    narrow = [e for e in space.effects if any(p.scan for p in e.parameters)]
    if not narrow:
        return start
    reduced = space_with(space, [e for e in space.effects if e not in narrow])
    q = start[[space.names.index(name) for name in reduced.names]]
    natural = space.natural(start)
    with contextlib.suppress(*UNSIMULATED):
        fit = fit_model(prepared, reduced, q, options=REFIT)
        for screened in screen(prepared, fit, narrow):
            for p, value in zip(screened.effect.parameters, screened.starts[0], strict=True):
                if (name := f"{screened.effect.name}.{p.name}") in space.names:
                    natural[space.names.index(name)] = value
    return np.asarray(np.clip(space.coordinates(natural), space.low, space.high))


def _of_likeliest_shape(
    setup: SearchSetup, prepared: PreparedStudy, start: FloatArray
) -> FloatArray:
    """Best end of first refits from a start, and from it with effects of other shapes."""
    space, starts = setup.space, [start]
    for effect in space.effects:
        index = {
            p: space.names.index(name)
            for p in effect.parameters
            if (name := f"{effect.name}.{p.name}") in space.names
        }
        shapes = itertools.product(*(p.starts if is_shape(p) else p.starts[:1] for p in index))
        for values in list(shapes)[1:MOST_GUESSES]:
            natural = space.natural(start)
            natural[list(index.values())] = values
            starts.append(np.clip(space.coordinates(natural), space.low, space.high))
    if len(starts) == 1:
        return start
    fits: list[Fit] = []
    for q in starts:
        if fits and not prepared.work.affords("other shapes of the model's effects"):
            break
        with contextlib.suppress(*UNSIMULATED):
            fits.append(fit_model(prepared, space, q, options=REFIT))
    return min(fits, key=lambda f: f.objective).q if fits else start
