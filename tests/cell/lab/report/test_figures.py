"""Figures of the lab: nothing hides anything, and what is drawn is named as what it is."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.files.figure_style import ADDED, least_px
from cell.identify.parameters import ParameterSpace
from cell.lab.data.results import (
    Diagnosis,
    Errors,
    MissingEffect,
    Peak,
    RankedEffect,
    RemainingError,
)
from cell.lab.data.work import ModelError
from cell.lab.report.cable_overlay import BELOW, HEIGHT, overlay
from cell.lab.report.figures import (
    by_trial,
    fit_history,
    history,
    profile_curves,
    profiles,
    ranking,
    waterfall,
)
from cell.lab.report.report import comparison_page, series_of
from cell.lab.strength.compare import compare_model
from cell.lab.strength.profiles import ParameterProfile

NAN = float("nan")


@pytest.fixture(scope="module")
def twins(make_study):
    """A study that states its error, and two models that err alike."""
    study = replace(make_study(seed=2), noise_std_m=2e-4)
    study = replace(study, trials=study.trials[1:3])
    space = ParameterSpace.of(study.cable, effects=(library()["air_drag"],))
    model = compare_model(study, space.model(space.mean), "first")
    return [model, replace(model, model="second")]


def named(figure, name):
    (trace,) = [t for t in figure.data if t.name == name]
    return trace


def diagnosis(*found, partial=(), left=None, **more):
    return Diagnosis(1e-4, Errors(9e-4, 1e-3), "missing", found, left=left, partial=partial, **more)


def effect(name, fitted_m, held_m=NAN):
    return MissingEffect(name, (), 1e-9, 90.0, {}, Errors(fitted_m, held_m))


def test_numbers_stand_on_the_outer_side_of_their_markers():
    """The held-out error above and the fitted one below, whichever was larger: one on the other."""
    figure = waterfall(diagnosis(effect("tip_mass", 4e-4, 3.9e-4)))
    held = named(figure, "on motions it was not fitted to")
    fitted = named(figure, "on motions it was fitted to")
    assert list(held.textposition) == ["top center", "bottom center"]
    assert list(fitted.textposition) == ["bottom center", "top center"]


def test_equal_numbers_do_not_stand_on_each_other(twins):
    figure = history([replace(c, heldout_rms_m=c.fit_rms_m) for c in twins])
    sides = [set(t.textposition) for t in figure.data]
    assert sides == [{"top center"}, {"bottom center"}]


@pytest.mark.parametrize("largest_m", [1.2e-3, 1e-1, 3.0])
def test_numbers_have_room_above_the_ticks_of_the_axis(largest_m):
    """A share of the height, however many decades it spans; it was 0.15 of a decade."""
    figure = waterfall(replace(diagnosis(), baseline=Errors(largest_m, 0.9 * largest_m)))
    low, high = figure.layout.yaxis.range
    span = high - low
    assert (np.log10(0.1) - low) / span > 0.1
    assert (high - np.log10(1e3 * largest_m)) / span > 0.1


def test_the_line_of_the_noise_has_its_name_in_the_legend_and_says_what_it_is(twins):
    """Beside the axis it ran into numbers; and a stated error is not the camera's noise."""
    measured, stated = waterfall(diagnosis()), waterfall(diagnosis(noise_is_stated=True))
    assert [(s.name, s.showlegend) for s in measured.layout.shapes] == [("noise 0.1 mm", True)]
    assert [s.name for s in stated.layout.shapes] == ["stated error 0.1 mm"]
    for figure in (history(twins), by_trial(series_of(twins))):
        assert [s.name for s in figure.layout.shapes] == ["stated error 0.2 mm"]
        assert not figure.layout.annotations
    assert "stated error" in [t.name for t in profiles(series_of(twins)).data]
    page = comparison_page(twins)
    assert "over stated error" in page
    assert ">over noise<" not in page


def test_what_was_fitted_to_all_motions_is_a_line_of_its_own():
    """It stood below "motions it was fitted to", as if it had been fitted to these alone."""
    left = RemainingError(3e-4, 8e-4, 3.0, 0.9, Peak("deep", 0.1, 0.1, 4.0))
    figure = waterfall(diagnosis(partial=(effect("tip_mass", 3e-4),), left=left))
    assert list(named(figure, "on all motions, fitted to all").y) == [0.8, 0.3]
    assert list(named(figure, "on motions it was fitted to").y) == [0.9, None]
    assert list(named(figure, "on motions it was not fitted to").y) == [1.0, None]


def test_of_two_equal_models_both_are_seen(twins):
    series = series_of(twins)
    for draw, part in ((by_trial, "marker"), (profiles, "line")):
        first, second = (
            next(t for t in draw(series).data if t.name == name)[part]
            for name in ("first", "second")
        )
        key = "size" if part == "marker" else "width"
        assert first[key] >= 2.0 + second[key]
    lines = [t for t in overlay(series, 0).data if t.name in ("first", "second")]
    assert lines[0].line.width >= 2.0 + lines[1].line.width


def test_evidence_is_listed_by_what_is_drawn():
    rows = tuple(
        RankedEffect(name, score, 1.0, status)
        for name, score, status in (
            ("tip_mass", 90.0, "present"), ("draught", 4.0, "absent"),
            ("grip_slip", 400.0, "absent"),
        )
    )  # fmt: skip
    figure = ranking(diagnosis(ranking=rows))
    from_below = list(figure.layout.yaxis.categoryarray)
    drawn = {y: x for t in figure.data for x, y in zip(t.x, t.y, strict=True)}
    assert from_below == sorted(drawn, key=drawn.get)


def test_legend_and_slider_labels_of_the_overlay_keep_apart(twins):
    figure = overlay(series_of(twins), 0)
    drawn = HEIGHT - BELOW - figure.layout.margin.t
    legend_px = -figure.layout.legend.y * drawn
    slider = figure.layout.sliders[0]
    labels_end_px = slider.pad.t + 20 + 26 + 40  # its value, its bar, ticks and their labels
    assert legend_px > labels_end_px
    assert BELOW - legend_px > 40


def test_pages_as_narrow_as_a_telephone_scroll_tables_and_panels(twins):
    page = comparison_page(twins)
    assert page.count("<table>") == page.count("<div class='wide'><table>") > 0
    assert ".wide,.plot{width:100%;overflow-x:auto}" in page
    series = series_of(twins)
    assert least_px(profiles(series)) == 930
    assert least_px(overlay(series, 0)) == 620
    assert least_px(by_trial(series)) == 270


def test_profiles_say_what_rises():
    of = ParameterProfile("rigidity", "N·m²", True, 2e-5, 2e-5, 1e-5, 3e-5, (1e-5, 3e-5),
                          np.array([1e-5, 2e-5, 3e-5]), np.array([3.84, 0.0, 3.84]), ((),) * 3,
                          False)  # fmt: skip
    figure = profile_curves([of] * 4)
    titles = [axis.title.text for axis in figure.select_yaxes()]
    assert [t for t in titles if t] == ["rise of −2 ln L"] * 2


def test_the_search_is_shown_from_the_baseline_to_the_least_error():
    fits = [
        ModelError((), 9e-4, 1e-4),
        ModelError(("air_drag",), 7e-4, 1e-4),
        ModelError(("tip_mass",), 2e-4, 1e-4),
        ModelError(("air_drag", "tip_mass"), 2.5e-4, 1e-4),
    ]
    figure = fit_history(diagnosis(effect("tip_mass", 2e-4), fit_errors=tuple(fits)))
    each, least = named(figure, "each model"), named(figure, "least so far")
    assert list(each.text) == ["baseline", "air_drag", "tip_mass", "air_drag + tip_mass"]
    assert list(least.y) == [0.9, 0.7, 0.2, 0.2]
    assert [c == ADDED for c in each.marker.color] == [False, False, True, False]
    assert [len(frame.data[1].y) for frame in figure.frames] == [1, 2, 3, 4]
