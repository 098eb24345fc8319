"""Copies of a recording are one recording, whatever was done to them; repetitions are not."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import decimate

from cell.cable.geometry import Cable, Motion
from cell.study.data import Markers, Study, Trial
from cell.study.independence import Independence, without_copies, without_copies_of
from cell.study.same_recording import same_recordings

CABLE = Cable(0.1, 0.0074, 0.016, 0.0001)
ARCS_M = np.linspace(0.1, 0.02, 5)
HOLD_S = 0.15


def hand_y_m(t_s, way_m):
    u = np.clip((t_s - HOLD_S) / 0.3, 0.0, 1.0)
    return -way_m * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def swing(t_s, way_m=0.05):
    """(T, markers, 2) a cable that follows its gripper, with two modes that decay."""
    after = np.maximum(t_s - HOLD_S, 0.0)[:, None]
    s = ARCS_M / CABLE.free_length_m
    first = np.exp(-3.0 * after) * np.sin(30.0 * after) * s**2
    second = 0.1 * np.exp(-9.0 * after) * np.sin(130.0 * after) * s * (s - 0.78)
    bend = 0.4 * way_m * (first + second)
    y = hand_y_m(t_s, way_m)[:, None] - 0.5 * ARCS_M * s + bend
    return np.stack([-ARCS_M + 0.3 * bend**2 / 0.1 + 0.0 * y, y], axis=2)


def seen(seed, *, rate_hz=200.0, noise_m=1e-4, ar1=0.0, lasts_s=1.2, way_m=0.05, markers=5):
    rng = np.random.default_rng(seed)
    t_s = np.arange(rng.uniform(0.0, 1.0) / rate_hz, lasts_s, 1.0 / rate_hz)
    xy_m = swing(t_s, way_m)[:, :markers]
    noise = rng.standard_normal(xy_m.shape)
    for before, now in pairwise(noise):
        now[:] = ar1 * before + np.sqrt(1.0 - ar1**2) * now
    return Markers(t_s, xy_m + noise_m * noise)


def trial(name, seed, role="fit", way_m=0.05, **more):
    t_s = np.arange(0.0, 1.2, 0.002)
    x_m = np.random.default_rng(seed).normal(0.0, 1e-5, len(t_s))
    motion = Motion(t_s, x_m, hand_y_m(t_s, way_m), np.zeros_like(t_s))
    return Trial(name, role, "equilibrium", motion, seen(seed, way_m=way_m, **more))


def study(*trials, name="made"):
    return Study(name, CABLE, ARCS_M, trials)


def is_copy(first, second):
    both = same_recordings([first, second]), same_recordings([second, first])
    assert both[0] == both[1]  # in whichever order
    return both[0] == (0, 0)


def turned(xy, angle):
    c, s = np.cos(angle), np.sin(angle)
    return xy @ np.array([[c, s], [-s, c]]) + [0.2, -0.1]


def resampled(m):
    t_s = np.arange(m.t_s[0], m.t_s[-1], 1.0 / 130.0)
    return Markers(t_s, CubicSpline(m.t_s, m.xy_m)(t_s))


def between_rows(m):
    t_s = np.arange(m.t_s[0], m.t_s[-1], 1.0 / 170.0)
    columns = m.xy_m.reshape(len(m.t_s), -1).T
    xy_m = np.stack([np.interp(t_s, m.t_s, v) for v in columns], axis=1)
    return Markers(t_s, xy_m.reshape(len(t_s), -1, 2))


def low_passed(m):
    ends = m.xy_m[:5].mean(axis=0), m.xy_m[-5:].mean(axis=0)
    share = np.linspace(0.0, 1.0, len(m.t_s))[:, None, None]
    line = ends[0] + share * (ends[1] - ends[0])
    half = decimate(m.xy_m - line, 2, axis=0, ftype="fir") + line[::2]
    return Markers(m.t_s[::2][5:-5], half[5:-5])


def with_gaps(m):
    lost = np.random.default_rng(1).random(m.xy_m.shape[:2]) < 0.05
    return Markers(m.t_s, np.where(lost[..., None], np.nan, m.xy_m))


COPIES = {
    "again": lambda m: m,
    "half the rate": lambda m: Markers(m.t_s[1::2], m.xy_m[1::2]),
    "a third of the rate": lambda m: Markers(m.t_s[::3], m.xy_m[::3]),
    "low-passed to half the rate": low_passed,
    "resampled": resampled,
    "resampled between rows": between_rows,
    "cropped": lambda m: Markers(m.t_s[70:190], m.xy_m[70:190]),
    "shifted in time": lambda m: Markers(m.t_s + 12.3456, m.xy_m),
    "a wrong rate": lambda m: Markers(1.6 * m.t_s, m.xy_m),
    "turned and moved": lambda m: Markers(m.t_s, turned(m.xy_m, 0.7)),
    "mirrored": lambda m: Markers(m.t_s, m.xy_m * [-1.0, 1.0]),
    "in millimetres": lambda m: Markers(m.t_s, 1e3 * m.xy_m),
    "rounded to half the noise": lambda m: Markers(m.t_s, np.round(2e4 * m.xy_m) / 2e4),
    "markers in another order": lambda m: Markers(m.t_s, m.xy_m[:, [3, 0, 4, 2, 1]]),
    "fewer markers": lambda m: Markers(m.t_s, m.xy_m[:, [3, 1]]),
    "one coordinate": lambda m: Markers(m.t_s, m.xy_m * [np.nan, 1.0]),
    "with gaps": with_gaps,
    "all of it": lambda m: Markers(
        m.t_s[40:200:2] - 3.1, np.round(1e3 * turned(m.xy_m[40:200:2, ::-1], 2.0), 2)
    ),
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("ar1", [0.0, 0.7])
def test_a_copy_is_the_same_recording(how, ar1):
    original = seen(3, ar1=ar1)
    assert is_copy(original, COPIES[how](original))


def test_a_short_copy_of_one_marker_is_the_same_recording():
    original = seen(4, markers=1, rate_hz=100.0, lasts_s=0.2)
    assert len(original.t_s) == 20
    assert is_copy(original, original)
    assert is_copy(original, Markers(original.t_s, np.round(turned(original.xy_m, 1.0), 5)))


def test_true_repetitions_are_independent():
    """The same motion of the same cable, of many rates, lengths and kinds of noise."""
    rng = np.random.default_rng(0)
    refused = []
    for number in range(60):
        kind = {
            "rate_hz": float(rng.choice([60.0, 100.0, 200.0, 400.0])),
            "noise_m": float(10.0 ** rng.uniform(-5.0, -3.3)),
            "ar1": float(rng.choice([0.0, 0.5, 0.9])),
            "markers": int(rng.choice([1, 2, 5])),
            "lasts_s": float(rng.choice([0.35, 0.6, 1.2])),
        }
        pair = [seen(2 * number + k, **kind) for k in (0, 1)]
        if rng.random() < 0.3:  # rows at the same times, and written to a tenth of a millimetre
            pair[1] = Markers(pair[0].t_s, pair[1].xy_m[: len(pair[0].t_s)])
            pair = [Markers(m.t_s[: len(m.xy_m)], np.round(m.xy_m, 4)) for m in pair]
        if same_recordings(pair) != (0, 1):
            refused.append(kind)
    assert not refused


def test_repetitions_without_noise_are_one_recording_and_other_motions_are_not():
    t_s = np.arange(0.0, 1.0, 0.005)
    clean = [Markers(t_s, swing(t_s, way_m)) for way_m in (0.05, 0.05, 0.08)]
    assert same_recordings(clean) == (0, 0, 2)


def test_recordings_and_motions_are_counted():
    first, other = trial("first", 1), trial("other", 2, "validate", way_m=0.08)
    copy = replace(first, name="copy", role="validate", markers=COPIES["mirrored"](first.markers))
    repeated = trial("repeated", 5, "validate")
    found = without_copies(study(first, copy, repeated, other))
    assert [t.name for t in found.trials] == ["first", "repeated", "other"]
    evidence = Independence.of(found)
    assert evidence.recordings == (("first", "copy"), ("repeated",), ("other",))
    assert evidence.motions == (("first", "copy", "repeated"), ("other",))
    assert (evidence.effective_trials, evidence.held_out) == (3.0, 1)
    assert str(evidence) == "effective trials 3.0 of 4, 2 motions, 1 held out"
    (note,) = found.notes
    assert "first and copy are one recording" in note
    assert "record the motion again" in note


def test_of_copies_the_one_with_most_values_stays_and_is_fitted_to():
    whole = trial("whole", 1, "validate")
    half = replace(whole, name="half", role="fit", markers=COPIES["half the rate"](whole.markers))
    (kept,) = without_copies(study(half, whole)).trials
    assert (kept.name, kept.role) == ("whole", "fit")
    assert Independence.of(without_copies(study(half, whole))).held_out == 0


def test_a_study_without_copies_stays_as_it_is():
    given = study(trial("first", 1), trial("again", 2))
    assert without_copies(given) is given


def test_what_another_study_has_already_is_left_out():
    known = study(trial("first", 1), trial("deep", 2, way_m=0.08), name="a")
    copy = replace(known.trials[1], name="d", markers=COPIES["cropped"](known.trials[1].markers))
    rest = without_copies_of(study(trial("own", 7), copy, name="b"), [known])
    assert [t.name for t in rest.trials] == ["own"]
    assert "trial d of b and deep of a are one recording" in rest.notes[0]
    with pytest.raises(ValueError, match="record the motion again, or leave c out"):
        without_copies_of(study(copy, name="c"), [known])
