"""Partial explanations keep their ties, and answers that a bound gave are none."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from cell.cable.effects import library
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.data.work import Work
from cell.lab.diagnosis import diagnose
from cell.lab.fit.fitting import space_with
from cell.lab.search import partial
from cell.lab.search.fit_cache import FitCache, SearchSetup
from cell.lab.search.fitted_model import ResidualSummary, log_variance_ratio, removed_share
from cell.lab.search.partial import largest_step
from cell.lab.verdict import conclusion, ties
from cell.lab.verdict.ties import tied_so_far
from tests.cell.lab.conftest import fits_of

KNOWN = library()


@pytest.fixture(scope="module")
def partly(make_study):
    """Late pictures, a load, and something that the library lacks."""
    hidden = [
        KNOWN["camera_latency"].active(delay_s=0.02),
        KNOWN["tip_mass"].active(mass_kg=6e-5),
        KNOWN["camera_scale"].active(factor=1.01),
    ]
    study = make_study(hidden, seed=31, hold_s=0.8)
    return diagnose(fits_of(study, ["camera_latency", "robot_lag", "tip_mass"]))


def test_an_effect_found_first_keeps_its_ties_when_a_second_is_in(partly):
    """Pictures late or a gripper late: no motion from rest tells them apart."""
    found = partly.diagnosis
    assert found.verdict == "unexplained"
    named = {f.effect: f.tied_with for f in found.partial}
    assert len(named) == 2
    assert "tip_mass" in named
    assert named.get("camera_latency", ("robot_lag",)) == ("robot_lag",)
    assert named.get("robot_lag", ("camera_latency",)) == ("camera_latency",)


def test_an_answer_that_a_bound_gave_explains_nothing(partly):
    """The first step is taken as it is, and not with its effect at the parameter's bound."""
    base, first, *_ = partly.partial
    space = first.fit.space
    (effect,) = first.effects
    setup = SearchSetup(partly.final_prepared, space_with(space, ()), {effect.name: effect})
    fits = FitCache.of(setup)
    assert largest_step(fits, base, [first]) is first
    q = first.fit.q.copy()
    q[-1] = space.high[-1]
    limited = replace(first, fit=replace(first.fit, q=q))
    assert largest_step(fits, base, [limited]) is None


def test_what_leaves_as_little_with_one_effect_more_is_tied_where_more_is_missing(monkeypatch):
    """A bar with 52 g at its tip: 0.32 mm with added mass, 0.41 with a tip mass, 0.30 of 0.03 mm
    of noise with a tip mass and relaxation.  Added mass alone was named.
    """
    left_mm = {
        ("added_mass",): 0.32,
        ("tip_mass",): 0.41,
        ("draught",): 0.52,
        ("air_drag",): 0.54,
        ("added_mass", "draught"): 0.30,
        ("draught", "robot_lag"): 0.45,
        ("stress_relaxation", "tip_mass"): 0.30,
        ("air_drag", "stress_relaxation"): 0.20,
    }
    models = {
        names: SimpleNamespace(names=frozenset(names), effects=[KNOWN[n] for n in names])
        for names in left_mm
    }
    noise = SimpleNamespace(noise=SimpleNamespace(std_m=3e-5))
    fits = SimpleNamespace(
        known=lambda: tuple(models.values()),
        base=None,
        prepared=SimpleNamespace(noise_model=noise),
        rules=DEFAULT_RULES,
    )
    monkeypatch.setattr(ties, "_as_good", lambda *args: [])
    monkeypatch.setattr(ties, "any_at_bound", lambda *args: False)
    for module in (ties, partial):
        monkeypatch.setattr(
            module,
            "residual_summary",
            lambda _, c: ResidualSummary((1e-3 * left_mm[tuple(sorted(c.names))]) ** 2, 80.0),
        )
    found = models[("added_mass",)]
    named = tied_so_far(fits, found, KNOWN["added_mass"])
    assert named == ("tip_mass",)  # draught does not; air drag is not among the nearest
    noise.noise = SimpleNamespace(std_m=3e-4)  # nothing beyond noise is left
    assert tied_so_far(fits, found, KNOWN["added_mass"]) == ()


def single(name, left_mm, ahead=0.0, at_bound=False):
    """A fitted effect that leaves so much, so many standard deviations worse than the best."""
    effects = [KNOWN[name]] if name else []
    fit = SimpleNamespace(solution=SimpleNamespace(converged=True))
    return SimpleNamespace(
        names=frozenset(e.name for e in effects),
        effects=effects,
        fit=fit,
        chi2=left_mm,
        left=ResidualSummary((1e-3 * left_mm) ** 2, 90.0),
        ahead=ahead,
        at_bound=at_bound,
    )


def test_ties_are_what_models_that_are_all_wrong_cannot_tell(monkeypatch):
    """A bar with 52 g at its tip: by 90 independent values tip mass (0.39 mm) was none of the ties
    of hysteresis (0.32), and an added mass at its bound was one.
    """
    base, final = single("", 0.54), single("bending_hysteresis", 0.32)
    others = [
        single("tip_mass", 0.39, ahead=1.1),
        single("natural_curvature", 0.39, ahead=2.5),
        single("added_mass", 0.31, at_bound=True),
        single("camera_latency", 0.50, ahead=1.4),  # significant, but little of the error
        single("stress_relaxation", 0.33, ahead=9.0),  # hardly more at all
    ]
    fits = SimpleNamespace(
        known=lambda: (base, final, *others),
        base=base,
        library=KNOWN,
        rules=DEFAULT_RULES,
        removed_share=lambda before, after: removed_share(3e-5, before.left, after.left),
        prepared=SimpleNamespace(noise_model=SimpleNamespace(noise=SimpleNamespace(std_m=3e-5))),
    )
    monkeypatch.setattr(ties, "near_singles", lambda *args: [])
    monkeypatch.setattr(ties, "is_at_bound", lambda small, large: large.at_bound)
    for module in (ties, partial):
        monkeypatch.setattr(module, "residual_summary", lambda _, c: c.left)
    monkeypatch.setattr(ties, "vuong_z", lambda _, better, worse: worse.ahead)
    monkeypatch.setattr(
        ties,
        "close_rivals",
        lambda *args: [
            c
            for c in others
            if log_variance_ratio(final.left, c.left) < DEFAULT_RULES.tie_delta_chi2
        ],
    )
    named = tied_so_far(fits, final, KNOWN["bending_hysteresis"])
    assert named == ("stress_relaxation", "tip_mass")


def test_singles_are_compared_when_their_fits_are_finished():
    """Twelve passes left 0.45 mm with a natural curvature, another eight 0.35."""
    base = single("", 0.54)
    initial_states = [
        single(n, 0.45) for n in ("natural_curvature", "tip_mass", "air_drag", "draught")
    ]
    initial_states.append(single("added_mass", 0.31))
    for candidate in initial_states[:-1]:
        candidate.fit.solution.converged = False
    asked = []

    def add(_, effects):
        asked.append(len(effects))
        return [single(e.name, 0.35) for e in effects]

    ended = partial._converged(SimpleNamespace(fit_extended=add, work=Work()), base, initial_states)
    assert [c.chi2 for c in ended] == [0.35, 0.35, 0.35, 0.35, 0.31]
    assert [c.names for c in ended] == [c.names for c in initial_states]
    assert asked == [3, 1]


def test_of_effects_put_in_order_each_must_be_worth_something_beside_those_before(monkeypatch):
    """A load explained "most" at p = 1: the one before it had been exchanged for a better."""
    base, first, second = single("", 30.0), single("natural_curvature", 10.0), single("", 9.9)
    second.names = frozenset({"natural_curvature", "tip_mass"})
    chances = {(base.names, first.names): 1e-9, (first.names, second.names): 0.2}
    monkeypatch.setattr(
        partial, "p_value_of", lambda _, small, large: chances[small.names, large.names]
    )
    steps, fits = [base, first, second], SimpleNamespace(rules=DEFAULT_RULES)
    assert partial._significant_steps(fits, steps) == [base, first]
    chances[first.names, second.names] = 1e-3
    assert partial._significant_steps(fits, steps) == steps


def test_what_was_not_fitted_to_the_fit_trials_alone_has_no_error_of_them(partly):
    """The error of all trials stood below "fitted"."""
    found = replace(partly.diagnosis.nearest[0])
    whole = partial.PartialExplanation(
        FitCache.of(SearchSetup(partly.final_prepared, space_with(partly.final.fit.space, ()), {})),
        tuple(c for c in partly.partial if len(c.names) == 1),
        partly.partial,
    )
    (near,) = conclusion.nearest(whole, ())
    assert near.left_rms_m > 0.0
    assert near.errors == conclusion.NOT_FITTED
    assert found.errors.heldout_rms_m > 0.0
