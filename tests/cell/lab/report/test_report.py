"""The report as a browser gets it: self-contained, every figure with its data, nothing blank."""

import json
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.data.check import Reading
from cell.lab.diagnosis import diagnose
from cell.lab.next.advice import advice
from cell.lab.report.report import comparison_page, diagnosis_page
from cell.lab.report.wording import catalogue_entry
from cell.lab.strength.compare import compare_model
from cell.lab.strength.estimate import identified
from cell.lab.verdict.doubts import omitted_doubts
from cell.study.data import Markers
from tests.cell.lab.conftest import fits_of


class Page(HTMLParser):
    """Scripts, figures, text and trials of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.figures, self.code, self.text, self.fetched = [], [], [], []
        self.trials, self._script = {}, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.fetched += [v for k, v in given.items() if k in ("src", "href")]
        if tag == "script":
            self._script = given.get("type", "code")
        if given.get("class") == "trial":
            self.trials[given["data-trial"]] = "hidden" not in given

    def handle_endtag(self, tag):
        if tag == "script":
            self._script = None

    def handle_data(self, data):
        if self._script == "application/json":
            self.figures.append(json.loads(data))
        elif self._script:
            self.code.append(data)
        else:
            self.text.append(data)


@pytest.fixture(scope="module")
def diagnosed(make_study):
    study = make_study([library()["tip_mass"].active(mass_kg=3e-5)], seed=12)
    fits = fits_of(study, ("tip_mass", "linear_air_drag"))
    examination = diagnose(fits)
    comparisons = [compare_model(study, c.fit.model) for c in examination.path]
    model = identified(fits.prepared, examination.path[-1].fit)
    asked = omitted_doubts(None, Reading(0.0, ("air_drag",)))
    warned = replace(examination.diagnosis, warnings=asked)
    text = diagnosis_page(warned, comparisons, model, advice(warned))
    return study, warned, comparisons, text


def test_its_warnings_stand_at_its_head(diagnosed):
    """They were printed and in the JSON, and whoever was sent the page never saw them."""
    words = " ".join(Page(diagnosed[-1]).text)
    warned = words.index("Warning: all trials together show air_drag beyond chance")
    assert warned < words.index("Error as effects are added")


def shown(figure, name):
    (trace,) = [t for t in figure["data"] if t.get("name") == name]
    return trace


def test_next_commands_are_given_to_be_copied_and_verdicts_explained(diagnosed):
    words = " ".join(Page(diagnosed[-1]).text)
    assert "cell fit STUDY --with tip_mass -o after.json" in words
    assert "`" not in words
    assert "missing in the model, confirmed on motions not fitted to" in words


def test_a_comparison_shows_models_side_by_side_on_logarithmic_axes(diagnosed):
    study, _, comparisons, _ = diagnosed
    before, after = (
        replace(c, model=n) for c, n in zip(comparisons, ("base", "with"), strict=True)
    )
    page = Page(comparison_page([before, after]))
    history, by_trial = page.figures[:2]
    held = shown(history, "on motions it was not fitted to")
    assert held["y"] == pytest.approx([1e3 * before.heldout_rms_m, 1e3 * after.heldout_rms_m], 1e-3)
    assert held["x"] == ["<b>base</b>", "<b>with</b><br>+ tip_mass"]
    for figure in (history, by_trial):
        assert figure["layout"]["yaxis"]["type"] == "log"
        low, high = figure["layout"]["yaxis"]["range"]
        assert low < np.log10(1e3 * before.noise_m) < high
    assert len(shown(by_trial, "with")["y"]) == len(study.trials)
    words = " ".join(page.text)
    assert "From “base” to “with” the error on motions not fitted to falls" in words
    assert "cell help effects , entry tip_mass." in " ".join(words.split())


def test_an_effect_of_ones_own_has_no_entry_in_the_catalogue():
    assert catalogue_entry(["mine"]) == ""
    said = catalogue_entry(["air_drag", "mine", "rest_shape", "air_drag"])
    assert said.endswith("`cell help effects`, entries air_drag, rest_shape.")


def overlays(page):
    return [f for f in page.figures if "sliders" in f["layout"]]


def test_the_page_needs_no_network_and_holds_plotly_once(diagnosed):
    *_, text = diagnosed
    page = Page(text)
    assert page.fetched == []
    assert "@import" not in text
    assert "url(" not in text[: text.index("<script>")]
    assert [len(c) > 1_000_000 for c in page.code].count(True) == 1
    assert len(text) < 8_000_000


def test_the_first_words_say_what_is_missing(diagnosed):
    page = Page(diagnosed[-1])
    words = " ".join(page.text)
    assert "with tip mass in it" in words
    assert words.index("with tip mass in it") < words.index("Error as effects are added")
    assert "Point mass with weight at the tip" in words  # the law
    assert "--with tip_mass" in words
    said = " ".join(words.split())
    assert "Limits, confusions and remedies: cell help effects , entry tip_mass." in said


def test_waterfall_and_ranking_show_the_diagnosis(diagnosed):
    _, diagnosis, _, text = diagnosed
    waterfall, fitted, ranking = Page(text).figures[:3]
    each = shown(fitted, "each model")
    assert "tip_mass" in each["text"] and each["y"][0] == max(each["y"])
    bars = shown(waterfall, "on motions it was not fitted to")
    assert bars["x"] == ["model", "+ tip_mass"]
    held = [diagnosis.baseline.heldout_rms_m, diagnosis.missing[0].errors.heldout_rms_m]
    assert bars["y"] == pytest.approx([1e3 * v for v in held], abs=1e-4)
    present = shown(ranking, "missing in the model")
    assert present["y"] == ["tip_mass"]
    assert present["x"][0] == pytest.approx(np.sqrt(diagnosis.ranking[0].score), abs=0.01)


def test_one_trial_is_open_the_one_with_the_largest_error(diagnosed):
    study, _, comparisons, text = diagnosed
    trials = Page(text).trials
    assert list(trials) == [t.name for t in study.trials]
    worst = max(comparisons[0].where, key=lambda w: w.rms_m).trial
    assert [name for name, is_open in trials.items() if is_open] == [worst]


def test_the_slider_moves_the_cable_and_leaves_the_tips_path_alone(diagnosed):
    study, _, _, text = diagnosed
    figures = overlays(Page(text))
    assert len(figures) == len(study.trials)
    for figure, trial in zip(figures, study.trials, strict=True):
        steps = figure["layout"]["sliders"][0]["steps"]
        frames = {f["name"]: f for f in figure["frames"]}
        assert [s["args"][0][0] for s in steps] == list(frames)
        assert len(frames) == 60
        for frame in frames.values():
            assert len(frame["data"]) == len(frame["traces"])
            seen = figure["data"][frame["traces"][0]]
            assert seen["name"] == "seen"
            k = int(frame["name"])
            assert frame["data"][0]["y"] == pytest.approx(
                1e3 * trial.markers.xy_m[k, :, 1], abs=2e-3
            )
        still = [t for i, t in enumerate(figure["data"]) if i not in frames["0"]["traces"]]
        heights = [t for t in still if t["yaxis"] == "y2"]
        assert [len(t["y"]) for t in heights] == [len(trial.markers.t_s)] * 3
        assert heights[0]["y"] == pytest.approx(1e3 * trial.markers.xy_m[:, 0, 1], abs=1e-3)


def test_maps_show_the_error_before_and_after_on_one_scale(diagnosed):
    study, _, comparisons, text = diagnosed
    maps = [f for f in Page(text).figures if f["data"][0]["type"] == "heatmap"]
    assert len(maps) == len(study.trials)
    before, after = (np.array(t["z"]) for t in maps[0]["data"])
    left = study.trials[0].markers.xy_m - comparisons[0].predicted_m["identify"]
    assert before == pytest.approx(np.log10(1e3 * np.linalg.norm(left, axis=2).T), abs=1e-4)
    assert after[0].mean() < before[0].mean()
    assert {t["coloraxis"] for t in maps[0]["data"]} == {"coloraxis"}


def test_a_single_marker_that_is_sometimes_lost_makes_a_page(make_study):
    study = make_study(seed=3)
    trials = []
    for trial in study.trials:
        xy_m = trial.markers.xy_m[:, :1].copy()
        xy_m[60:90] = np.nan
        trials.append(replace(trial, markers=Markers(trial.markers.t_s, xy_m)))
    study = replace(study, arc_length_m=study.arc_length_m[:1], trials=tuple(trials))
    model = ParameterSpace.of(study.cable)
    page = Page(comparison_page([compare_model(study, model.model(model.mean))]))
    cable = shown(overlays(page)[0], "model")
    assert len(cable["x"]) == 21  # the whole cable, not the one marker
    assert cable["x"][-1] - cable["x"][0] > 50.0
    assert None in overlays(page)[0]["data"][0]["y"]  # a gap, not a line across it
