"""Measurements that no cable makes are refused where they are read; what is merely odd is told."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.api.lab import fit_study
from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.files.input_error import InputError
from cell.identify.noise import Noise
from cell.lab.data.named_effects import select_effects
from cell.lab.data.opened_study import open_study
from cell.lab.search.setup import fit_cache_of
from cell.study.clocks import WEAK_M_PER_S2, cut_off, offset, pull_m_per_s2
from cell.study.data import Markers, Study, Trial
from cell.study.folder import MAX_FRAMES, read_study, write_study
from cell.study.tracks import Exchange, exchanges
from cell.study.trial_checks import TrialEvidence, frozen_marker, trial_problems

Change = Callable[[Study], Study]
Lines = tuple[int, int]


@pytest.fixture(scope="module")
def swung() -> Study:
    """A simulated cable that is jerked down and swings."""
    t = np.arange(0.0, 1.2, 0.005)
    x = np.clip((t - 0.2) / 0.3, 0.0, 1.0)
    grip = Motion(t, 0.3 + 0 * t, 0.2 - 0.05 * x**3 * (10 - 15 * x + 6 * x**2), 0.1 + 0 * t)
    arcs = np.linspace(0.1, 0.0, 6)
    cable = Cable(0.1, 0.0074, 0.016, 1e-4)
    model = CableModel.uniform(cable, 3e-5, viscosity_n_m2_s=1e-7)
    xy_m = simulate(model, grip, t, arcs)[0]
    xy_m = xy_m + np.random.default_rng(1).normal(0.0, 1e-4, xy_m.shape)
    return Study("s", cable, arcs, (Trial("a", "fit", "equilibrium", grip, Markers(t, xy_m)),))


def with_trial(study: Study, *, grip: Motion | None = None, **markers: np.ndarray) -> Study:
    trial = study.trials[0]
    trial = replace(trial, grip=grip or trial.grip, markers=replace(trial.markers, **markers))
    return replace(study, trials=(trial,))


def mirrored(study: Study) -> Study:
    trial = study.trials[0]
    grip = replace(trial.grip, x_m=-trial.grip.x_m)
    return with_trial(study, grip=grip, xy_m=trial.markers.xy_m * [-1.0, 1.0])


def y_down(study: Study) -> Study:
    trial = study.trials[0]
    grip = replace(trial.grip, y_m=-trial.grip.y_m, angle_rad=-trial.grip.angle_rad)
    return with_trial(study, grip=grip, xy_m=trial.markers.xy_m * [1.0, -1.0])


def slower(factor: float) -> Change:
    def change(study: Study) -> Study:
        trial = study.trials[0]
        grip = replace(trial.grip, t_s=trial.grip.t_s * factor)
        return with_trial(study, grip=grip, t_s=trial.markers.t_s * factor)

    return change


def reversed_markers(study: Study) -> Study:
    return with_trial(study, xy_m=study.trials[0].markers.xy_m[:, ::-1])


def only(marker: int, change: Change) -> Change:
    """The same of a study in which a single marker was seen."""

    def changed(study: Study) -> Study:
        xy_m = change(study).trials[0].markers.xy_m.copy()
        xy_m[:, np.arange(6) != marker] = np.nan
        return with_trial(change(study), xy_m=xy_m)

    return changed


def refusal(study: Study, folder: Path) -> str:
    """Why the study is refused: one sentence."""
    write_study(study, folder)
    with pytest.raises(InputError) as caught:
        read_study(folder)
    (problem,) = caught.value.problems
    return str(problem)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (reversed_markers, "turn markers.arc_length_m round"),
        (only(0, lambda s: with_trial(s, xy_m=s.trials[0].markers.xy_m - 0.2)), "lies more than"),
        (mirrored, "change the sign of x_m in both files"),
        (only(0, mirrored), "change the sign of x_m in both files"),
        (slower(1000.0), "give seconds, not milliseconds"),
        (slower(200.0), "limit 30 s; give seconds"),
        (
            lambda s: with_trial(
                slower(24.0)(s), **{
                    "t_s": s.trials[0].markers.t_s[::60] * 24.0,
                    "xy_m": s.trials[0].markers.xy_m[::60],
                }
            ),
            "frames are 7.2 s apart, yet a cable of 0.1 m swings to and fro within 0.63 s",
        ),
    ],
)  # fmt: skip
def test_what_no_cable_does_is_refused(
    swung: Study, tmp_path: Path, change: Change, says: str
) -> None:
    assert says in refusal(change(swung), tmp_path)


def changed(study: Study, change: Callable[[np.ndarray], None]) -> Study:
    xy_m = study.trials[0].markers.xy_m.copy()
    change(xy_m)
    return with_trial(study, xy_m=xy_m)


def test_exchanged_markers_are_told_with_the_line_from_which_on_they_are(
    swung: Study, tmp_path: Path
) -> None:
    def exchange(xy_m: np.ndarray) -> None:
        xy_m[149:, [0, 3]] = xy_m[149:, [3, 0]]

    said = refusal(changed(swung, exchange), tmp_path)
    assert "a/markers.csv:151: x0_m: marker 0 is where marker 3 was" in said
    assert "exchange the columns of the two in the rows from here to line 241" in said


def test_a_marker_that_is_too_far_from_a_line_on_is_told_with_that_line(
    swung: Study, tmp_path: Path
) -> None:
    def away(xy_m: np.ndarray) -> None:
        xy_m[79:, 5] -= [0.14, 0.0]

    said = refusal(changed(swung, away), tmp_path)
    assert "a/markers.csv:81: the marker at arc length 0 m is" in said


def logged_without(study: Study, from_s: float, to_s: float) -> Study:
    grip = study.trials[0].grip
    kept = (grip.t_s <= from_s) | (grip.t_s >= to_s)
    return with_trial(study, grip=Motion(*(v[kept] for v in vars(grip).values() if len(v) > 9)))


def test_a_gap_in_the_log_of_a_hand_that_moves_is_told_with_its_size(
    swung: Study, tmp_path: Path
) -> None:
    said = refusal(logged_without(swung, 0.1, 0.7), tmp_path / "moves")
    assert "a/grip.csv:23: t_s: the gripper is not seen from 0.1 to 0.7 s, limit 0.1 s" in said
    write_study(logged_without(swung, 0.52, 1.1), tmp_path / "rests")
    assert read_study(tmp_path / "rests").notes == ()


@pytest.mark.parametrize(
    ("kept_s", "says"),
    [
        (
            (0.0, 0.38),
            "a/grip.csv:78: t_s: the log ends at 0.38 s, while the gripper moves at 0.3 m/s",
        ),
        (
            (0.3, 2.0),
            "a/grip.csv:2: t_s: the log begins at 0.3 s, while the gripper moves at 0.26 m/s",
        ),
        ((0.0, 0.5), None),  # a log may end as soon as the gripper rests
        ((0.19, 2.0), None),
        ((0.0, 1.1), None),
    ],
)
def test_a_log_that_ends_or_begins_in_motion_is_refused(
    swung: Study, tmp_path: Path, kept_s: tuple[float, float], says: str | None
) -> None:
    """The gripper was held where its log ended, a few millimetres short of where it went."""
    grip = swung.trials[0].grip
    kept = (grip.t_s >= kept_s[0] - 1e-9) & (grip.t_s <= kept_s[1] + 1e-9)
    short = Motion(*(v[kept] for v in (grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)))
    if says is None:
        write_study(with_trial(swung, grip=short), tmp_path)
        read_study(tmp_path)
        return
    assert says in refusal(with_trial(swung, grip=short), tmp_path)
    seen = (swung.trials[0].markers.t_s >= kept_s[0]) & (swung.trials[0].markers.t_s <= kept_s[1])
    markers = swung.trials[0].markers
    cut = with_trial(swung, grip=short, t_s=markers.t_s[seen], xy_m=markers.xy_m[seen])
    assert cut_off(_poses(short), float(cut.trials[0].markers.t_s[0]), kept_s[1]) is None


def test_an_angle_that_jumps_by_a_whole_turn_is_refused(swung: Study, tmp_path: Path) -> None:
    """Of a clamp that points to the right the noise goes over ±π: the model's gripper spun
    round."""
    grip = mirrored(swung).trials[0].grip
    angle_rad = np.pi + np.random.default_rng(1).normal(0.0, 1e-3, len(grip.t_s))
    study = with_trial(mirrored(swung), grip=replace(grip, angle_rad=angle_rad))
    write_study(study, tmp_path)
    read_study(tmp_path)
    wrapped = replace(grip, angle_rad=(angle_rad + np.pi) % (2.0 * np.pi) - np.pi)
    said = refusal(with_trial(study, grip=wrapped), tmp_path)
    assert re.search(r"a/grip.csv:\d+: angle_rad: .*a whole turn away; write", said)


def _poses(grip: Motion) -> np.ndarray:
    return np.column_stack([grip.t_s, grip.x_m, grip.y_m, grip.angle_rad])


@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize(("noise", "digit"), [(0.0, 0.0), (1e-4, 0.0), (0.0, 1e-3)])
def test_no_rest_is_taken_for_motion_by_noise_or_digits(
    rate_hz: float, noise: float, digit: float
) -> None:
    for lasts_s in np.arange(0.5, 0.65, 0.01):
        t_s = np.arange(0.0, lasts_s, 1.0 / rate_hz)
        x = np.clip((t_s - 0.2) / 0.3, 0.0, 1.0)
        place = 0.05 * x**3 * (10 - 15 * x + 6 * x**2)
        place = place + np.random.default_rng(int(1e3 * lasts_s)).normal(0.0, noise, len(t_s))
        place = np.round(place / digit) * digit if digit else place
        for poses in (
            np.column_stack([t_s, place, 0 * t_s, 0 * t_s]),
            np.column_stack([t_s, 0 * t_s, 0 * t_s, 10 * place]),
        ):
            assert cut_off(poses, 0.0, 2.0) is None
            moving = cut_off(poses[: int(0.38 * rate_hz)], 0.0, 2.0)
            assert moving is not None and moving.at_end


@pytest.mark.parametrize("late_s", [0.5, -0.5])
def test_clocks_that_differ_are_told_with_line_and_size(
    swung: Study, tmp_path: Path, late_s: float
) -> None:
    t_s = swung.trials[0].markers.t_s + late_s
    write_study(with_trial(swung, t_s=t_s), tmp_path)
    try:
        (said,) = read_study(tmp_path).notes
        assert late_s < 0.0
    except InputError as error:
        said = str(error)
    line = int(re.search(r"markers.csv: ?(?:line )?(\d+): ", said).group(1))  # type: ignore[union-attr]
    # The gripper, and the cable with it, is a few millimetres away at 0.26 s.
    assert t_s[line - 2] == pytest.approx(0.26 + late_s, abs=0.03)
    assert ("subtract this" if late_s > 0 else "add 0.5 s to t_s of markers.csv") in said


def of_one_side(dx_m: float, dy_m: float, late_s: float = 0.0) -> tuple[Trial, Cable]:
    """A cable that hangs askew, of which x alone is measured, and its pictures' clock ahead."""
    t = np.arange(0.0, 1.3, 0.005)
    x = np.clip((t - 0.2) / 0.3, 0.0, 1.0)
    s = x**3 * (10 - 15 * x + 6 * x**2)
    grip, cable = Motion(t, dx_m * s, dy_m * s, 1.4 + 0 * t), Cable(0.085, 0.0074, 0.016, 1e-4)
    model = CableModel.uniform(cable, 1e-5, viscosity_n_m2_s=1e-7)
    xy_m = simulate(model, grip, t, np.array([0.07]))[0]
    xy_m = xy_m + np.random.default_rng(1).normal(0.0, 2e-4, xy_m.shape)
    return Trial("a", "fit", "equilibrium", grip, Markers(t + late_s, xy_m * [1.0, np.nan])), cable


def test_of_a_coordinate_along_which_no_hand_moves_no_clock_is_told() -> None:
    """It was refused: the gripper moves up, and the cable swings to the side a while later."""
    for dy_m in (0.04, -0.04, 0.08):
        trial, cable = of_one_side(0.0, dy_m)
        assert offset(trial, cable, 9.81) is None


@pytest.mark.parametrize("late_s", [0.5, -0.5])
def test_by_one_coordinate_clocks_that_differ_are_told(late_s: float) -> None:
    trial, cable = of_one_side(0.05, 0.05, late_s)
    found = offset(trial, cable, 9.81)
    assert found is not None
    assert found.late_s == pytest.approx(late_s, abs=0.1)


def sweep(
    size_m: float, turn_rad: float, top_hz: float, late_s: float = 0.0
) -> tuple[Trial, Cable]:
    """A cable whose gripper oscillates and turns, faster and further; its pictures' clock ahead."""
    t = np.arange(0.0, 2.6, 0.005)
    u = np.clip((t - 0.3) / 2.2, 0.0, 1.0)
    wave = np.sin(np.pi * u) ** 4 * np.sin(np.pi * top_hz * (t - 0.3) * (1.0 + u))
    grip, cable = Motion(t, 0 * t, size_m * wave, turn_rad * wave), Cable(0.3, 0.03, 0.016, 1e-4)
    model = CableModel.uniform(cable, 2e-3, viscosity_n_m2_s=1e-5)
    xy_m = simulate(model, grip, t, np.array([0.3, 0.15]))[0]
    xy_m = xy_m + np.random.default_rng(1).normal(0.0, 1e-4, xy_m.shape)
    return Trial("a", "fit", "equilibrium", grip, Markers(t + late_s, xy_m)), cable


@pytest.mark.parametrize("motion", [(0.03, 0.1, 1.0), (0.02, -0.1, 1.0), (0.02, 0.2, 7.0)])
def test_an_oscillation_that_grows_is_of_one_clock(motion: tuple[float, float, float]) -> None:
    """It was refused: of a growing swing one distance is passed by the gripper or by the cable
    first, and half a period later by the other."""
    trial, cable = sweep(*motion)
    assert offset(trial, cable, 9.81) is None
    late, cable = sweep(*motion, late_s=0.8)
    assert offset(late, cable, 9.81) is not None


@pytest.mark.parametrize("shared", [False, True])
def test_rows_in_which_nothing_is_seen_are_no_rest(swung: Study, shared: bool) -> None:
    """Every second row was empty, or two cameras took turns: clocks were said to differ by 1 s."""
    xy_m = swung.trials[0].markers.xy_m.copy()
    xy_m[::2, ::2] = np.nan
    xy_m[1::2, 1::2] = np.nan
    if not shared:
        xy_m[::2] = np.nan
    (trial,) = with_trial(swung, xy_m=xy_m).trials
    assert offset(trial, swung.cable, 9.81) is None
    (late,) = with_trial(swung, xy_m=xy_m, t_s=trial.markers.t_s + 0.5).trials
    found = offset(late, swung.cable, 9.81)
    assert found is not None
    assert found.late_s == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(
    ("rows", "place", "lines"),
    [
        (slice(60, 110), None, (62, 111)),  # a tracker goes on to write where it saw a marker last
        (slice(None), (0.0, 0.0), (2, 241)),  # or zeros
    ],
)
def test_a_marker_that_stays_exactly_in_place_is_refused_as_lost(
    swung: Study, tmp_path: Path, rows: slice, place: tuple[float, float] | None, lines: Lines
) -> None:
    def stays(xy_m: np.ndarray) -> None:
        xy_m[rows, 2] = xy_m[rows, 2][0] if place is None else np.add(place, [0.3, 0.2])

    said = refusal(changed(swung, stays), tmp_path)
    assert "leave its values empty there" in said
    assert f"markers.csv:{lines[0]}: the marker at arc length 0.06 m stays" in said
    assert f"up to line {lines[1]}, while the cable moves by" in said


def test_a_hand_in_millimetres_is_told_so(swung: Study, tmp_path: Path) -> None:
    """Its clock was said to be off, for it had moved by much more than the cable at once."""
    grip = swung.trials[0].grip
    grip = replace(grip, x_m=1e3 * grip.x_m, y_m=1e3 * (grip.y_m - 0.2))
    markers_m = swung.trials[0].markers.xy_m - np.array([0.3, 0.2])
    grip = replace(grip, x_m=grip.x_m - grip.x_m[0])
    said = refusal(with_trial(swung, grip=grip, xy_m=markers_m), tmp_path)
    assert "give metres, not millimetres" in said
    assert "a/grip.csv:2: x_m, y_m: the gripper's places are up to 50 m apart" in said


def evidence_of(trial: Trial, study: Study) -> TrialEvidence:
    return TrialEvidence(trial, study.cable, study.arc_length_m, study.gravity_m_per_s2)


def test_a_marker_that_is_rounded_to_pixels_is_not_lost(swung: Study) -> None:
    xy_m = np.round(swung.trials[0].markers.xy_m, 3)
    (trial,) = with_trial(swung, xy_m=xy_m).trials
    assert frozen_marker.failure(evidence_of(trial, swung)) is None
    xy_m[:, 2, 0], xy_m[:, 2, 1] = 0.25, np.nan  # a laser sees one coordinate, which may stay
    (trial,) = with_trial(swung, xy_m=xy_m).trials
    assert frozen_marker.failure(evidence_of(trial, swung)) is None


def test_a_marker_that_turns_is_not_lost_though_it_is_rounded(swung: Study) -> None:
    """One step of 3 mm is more than a marker moves in some frames while the gripper moves on."""
    trial, step_m = swung.trials[0], 0.003
    xy_m = step_m * np.round(trial.markers.xy_m / step_m)
    (rounded,) = with_trial(swung, xy_m=xy_m).trials
    assert frozen_marker.failure(evidence_of(rounded, swung)) is None
    xy_m[80:100, 2] = 0.0
    (lost,) = with_trial(swung, xy_m=xy_m).trials
    found = frozen_marker.failure(evidence_of(lost, swung))
    assert found is not None and (found.row, found.values["last"]) == (80, 101)


def test_y_downwards_is_doubted(swung: Study, tmp_path: Path) -> None:
    """A naturally curved cable may rise, so this alone is no reason to refuse a study."""
    write_study(y_down(swung), tmp_path)
    (note,) = read_study(tmp_path).notes
    assert "a/markers.csv: at rest the cable rises" in note
    assert "check the signs of y_m" in note


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_a_cable_may_leave_the_clamp_to_either_side(
    swung: Study, tmp_path: Path, turn: float
) -> None:
    study = swung
    if turn:
        trial = mirrored(swung).trials[0]
        grip = replace(trial.grip, angle_rad=np.pi - trial.grip.angle_rad)
        study = replace(swung, trials=(replace(trial, grip=grip),))
    write_study(study, tmp_path)
    assert read_study(tmp_path).notes == ()


def test_more_frames_than_a_swing_needs_are_thinned_and_that_is_said(
    swung: Study, tmp_path: Path
) -> None:
    trial = swung.trials[0]
    t_s = np.linspace(0.0, 1.19, 2 * MAX_FRAMES + 1)
    frames = np.searchsorted(trial.markers.t_s, t_s, side="right") - 1
    write_study(with_trial(swung, t_s=t_s, xy_m=trial.markers.xy_m[frames]), tmp_path)
    read = read_study(tmp_path)
    assert np.array_equal(read.trials[0].markers.t_s, t_s[::3])
    assert "one of every 3 of the 10001 frames is taken" in read.notes[0]


def test_half_a_million_rows_are_refused_at_once(swung: Study, tmp_path: Path) -> None:
    write_study(swung, tmp_path)
    path = tmp_path / "a" / "grip.csv"
    path.write_text("t_s,x_m,y_m,angle_rad\n" + "0,0,0,0\n" * 500_000)
    with pytest.raises(InputError, match=r"grip.csv:60000: has 500001 rows, limit 60000; cut"):
        read_study(tmp_path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t_s,x_m,y_m,angle_rad\n0,0,0,0\n" + '"' + "x" * 200_000, ":3: is not CSV: field larger"),
        ("t_s,x_m,y_m,angle_rad\n0,0,0,0\n1,\0,0,0\n", ":3: x_m: '\\x00' is not a number"),
        ("t_s,x_m,y_m,angle_rad\n0,0,0,0\n1,1e300,0,0\n", ":3: x_m: 1e+300 is beyond ±100 m"),
    ],
)
def test_what_is_no_table_is_refused(swung: Study, tmp_path: Path, text: str, says: str) -> None:
    write_study(swung, tmp_path)
    (tmp_path / "a" / "grip.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_study(tmp_path)
    assert f"grip.csv{says}" in str(caught.value)


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 100.0, 200.0])
def test_a_film_may_begin_at_any_moment_of_the_swing(swung: Study, rate_hz: float) -> None:
    """A cable that is filmed after a stroke swings, whatever it looks like in the first frames."""
    trial = swung.trials[0]
    t_s = np.arange(0.0, 1.2, 1.0 / rate_hz)
    xy_m = np.moveaxis(
        [
            [np.interp(t_s, trial.markers.t_s, trial.markers.xy_m[:, n, k]) for k in range(2)]
            for n in range(trial.markers.xy_m.shape[1])
        ],
        -1,
        0,
    )
    for from_s in np.arange(0.55, 0.9, 0.01):
        filmed = t_s >= from_s
        study = with_trial(swung, t_s=t_s[filmed], xy_m=xy_m[filmed])
        assert offset(study.trials[0], study.cable, 9.81) is None, from_s


def cable(frames_per_s: float, noise_m: float = 2e-4) -> np.ndarray:
    """(T, 6, 2) markers of a cable of 0.1 m that swings by ±1 rad at 2 Hz, m."""
    t_s = np.arange(0.0, 2.0, 1.0 / frames_per_s)
    angle = np.sin(2.0 * np.pi * 2.0 * t_s)[:, None] + 0.5 * np.pi
    arcs = np.linspace(0.1, 0.0, 6)
    xy_m = np.stack([arcs * np.cos(angle), -arcs * np.sin(angle)], axis=-1)
    return xy_m + np.random.default_rng(1).normal(0.0, noise_m, xy_m.shape)


@pytest.mark.parametrize("frames_per_s", [30.0, 100.0, 500.0])
@pytest.mark.parametrize("noise_m", [1e-5, 5e-4, 5e-3, 5e-2])
def test_a_swing_exchanges_nothing(frames_per_s, noise_m):
    assert exchanges(cable(frames_per_s, noise_m)) == []


@pytest.mark.parametrize(("one", "other"), [(0, 1), (0, 5), (2, 4)])
def test_an_exchange_is_found_in_its_row_to_its_end(one, other):
    xy_m = cable(100.0)
    xy_m[149:, [one, other]] = xy_m[149:, [other, one]]
    assert exchanges(xy_m) == [Exchange(one, other, 149, 200)]
    xy_m[180:, [one, other]] = xy_m[180:, [other, one]]
    assert exchanges(xy_m) == [Exchange(one, other, 149, 180)]


def test_where_both_are_lost_the_row_is_that_in_which_they_are_seen_again():
    xy_m = cable(200.0)
    xy_m[149:, [0, 3]] = xy_m[149:, [3, 0]]
    xy_m[149, [0, 3]] = np.nan
    assert exchanges(xy_m) == [Exchange(0, 3, 150, 400)]


LENGTH_M, FREQUENCY_HZ, DENSITY = 0.2, 4.0, 0.015
CABLE = Cable(LENGTH_M, DENSITY, 0.016, 3e-4)
#: Of a uniform clamped strip: ω² = 12.362 EI/(ρ L⁴).
RIGIDITY = DENSITY * (2 * np.pi * FREQUENCY_HZ) ** 2 * LENGTH_M**4 / 12.362
VISCOSITY = RIGIDITY * 0.03 / (np.pi * FREQUENCY_HZ)
ARCS = np.linspace(LENGTH_M, 0.1 * LENGTH_M, 6)


@pytest.fixture(scope="module")
def level() -> Study:
    """Swept sideways in a level plane, without gravity in it."""
    model = CableModel.uniform(CABLE, RIGIDITY, 1.0, VISCOSITY, (0.0, 0.0))
    rng, trials = np.random.default_rng(5), []
    for name, stroke in (("one", 0.06), ("two", -0.05)):
        t = np.arange(0.0, 2.4, 0.004)
        s = np.clip((t - 0.4) / 0.2, 0.0, 1.0)
        y = stroke * s**3 * (10 - 15 * s + 6 * s**2)
        grip = Motion(t, 0 * t, y, 0 * t)
        seen = t[::2]
        xy_m = simulate(model, grip, seen, ARCS, solver=Solver(segments=30))[0]
        xy_m = xy_m + rng.normal(0.0, 1e-4, xy_m.shape)
        trials.append(Trial(name, "fit", "equilibrium", grip, Markers(seen, xy_m)))
    return Study("level", CABLE, ARCS, tuple(trials), (0.0, 0.0))


def test_the_pull_is_that_under_which_the_cable_would_swing_as_it_does(level: Study) -> None:
    pull = pull_m_per_s2(level)
    assert pull is not None
    supposed = 0.4 * DENSITY * pull * LENGTH_M**3
    assert supposed == pytest.approx(RIGIDITY, rel=0.15)
    upright = replace(level, gravity_m_per_s2=(0.0, -9.81))
    assert pull_m_per_s2(upright) is None
    assert upright.scale_m_per_s2 == 9.81


def test_without_gravity_and_without_a_swing_nothing_tells_the_rigidity(
    level: Study, tmp_path: Path
) -> None:
    short = [
        replace(t, markers=Markers(t.markers.t_s[:76], t.markers.xy_m[:76])) for t in level.trials
    ]
    write_study(replace(level, trials=tuple(short)), tmp_path)
    with pytest.raises(InputError, match="record three swings after the motion"):
        open_study(tmp_path)


def test_a_level_cable_is_read_and_its_rigidity_and_viscosity_are_found(
    level: Study, tmp_path: Path
) -> None:
    write_study(level, tmp_path)
    opened = open_study(tmp_path)
    assert not opened.notes
    assert opened.gravity_m_per_s2 == (0.0, 0.0)
    model, _, _ = fit_study(fit_cache_of(opened, select_effects([])))
    low, high = model.interval()
    names = list(model.space.names)
    viscosity = names.index("viscosity")
    assert low[viscosity] < VISCOSITY < high[viscosity]
    middle = [names.index(f"rigidity_{i}") for i in range(4)]
    assert np.exp(np.mean(np.log(model.values[middle]))) == pytest.approx(RIGIDITY, rel=0.03)
    back = type(model).from_dict(model.to_dict())
    assert back.space.pull_m_per_s2 == opened.pull_m_per_s2
    assert isinstance(model.noise, Noise)


def test_a_weak_gravity_makes_no_record_too_short(level: Study, tmp_path: Path) -> None:
    """A droop of a tenth of a millimetre was once taken for a swing of eleven seconds."""
    weak = replace(level, gravity_m_per_s2=(0.0, -0.05))
    assert abs(weak.gravity_m_per_s2[1]) < WEAK_M_PER_S2
    write_study(weak, tmp_path)
    assert open_study(tmp_path).pull_m_per_s2 is not None


def refused(trial: Trial, gravity_m_per_s2: tuple[float, float] = (0.0, 0.0)) -> str:
    problems, _ = trial_problems(trial, CABLE, ARCS, gravity_m_per_s2)
    return " ".join(map(str, problems))


def test_both_ends_held_is_refused_in_one_sentence(level: Study, tmp_path: Path) -> None:
    trial = level.trials[0]
    share = ARCS / LENGTH_M
    hand = np.column_stack(
        [np.interp(trial.markers.t_s, trial.grip.t_s, v) for v in (trial.grip.x_m, trial.grip.y_m)]
    )
    # Bowed between the gripper and a post at its other end, which stays.
    rest = np.stack([-0.9 * ARCS, 0.05 * LENGTH_M * np.sin(np.pi * share)], axis=1)
    xy_m = rest + hand[:, None] * (1.0 - share)[:, None]
    xy_m = xy_m + np.random.default_rng(1).normal(0.0, 1e-4, xy_m.shape)
    held = replace(trial, markers=Markers(trial.markers.t_s, xy_m))
    said = refusal(replace(level, trials=(held,)), tmp_path)
    assert "both ends of this cable are held" in said
    xy_m[::2, 0] = xy_m[1::2, 1:] = np.nan  # by two cameras, one of which sees the tip alone
    still = replace(held, grip=Motion(trial.grip.t_s, *np.zeros((3, len(trial.grip.t_s)))))
    assert "the cable between moves" in refused(still)


def test_a_coordinate_that_is_not_seen_does_not_hold_the_tip(level: Study) -> None:
    """A laser sees the tip along the cable, the gripper moves across it."""
    for trial in level.trials:
        along_m = trial.markers.xy_m.copy()
        along_m[..., 1] = np.nan
        seen = replace(trial, markers=Markers(trial.markers.t_s, along_m))
        assert not refused(seen)


@pytest.mark.parametrize("gravity_m_per_s2", [(0.0, 0.0), (0.0, -0.05)])
@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_clocks_that_differ_are_seen_without_gravity(
    level: Study, gravity_m_per_s2: tuple[float, float], late_s: float
) -> None:
    """How long a cable may wait for its gripper is as it swings, not as it would hang."""
    for trial in level.trials:
        markers = Markers(trial.markers.t_s + late_s, trial.markers.xy_m)
        found = refused(replace(trial, markers=markers), gravity_m_per_s2)
        assert bool(found) == (late_s != 0.0)


@pytest.mark.parametrize(
    ("until_s", "lost"),
    [
        (np.inf, slice(0)),
        (0.42, slice(None)),  # the record ends before the gripper, that moves from 0.4 s to 0.6 s
        (0.42, slice(0, 1)),  # only the tip is lost then: it was taken for one that stays
    ],
)
def test_no_free_cable_is_taken_for_one_that_is_held_twice(
    level: Study, until_s: float, lost: slice
) -> None:
    for trial in level.trials:
        xy_m = trial.markers.xy_m.copy()
        xy_m[trial.markers.t_s > until_s, lost] = np.nan
        assert not refused(replace(trial, markers=Markers(trial.markers.t_s, xy_m)))


def test_a_record_that_ends_before_the_hand_moves_says_nothing_of_the_tip(level: Study) -> None:
    """It was once refused as one of a cable whose both ends are held."""
    trial = level.trials[0]
    early = trial.markers.t_s < 0.42
    short = replace(trial, markers=Markers(trial.markers.t_s[early], trial.markers.xy_m[early]))
    assert not refused(short)
