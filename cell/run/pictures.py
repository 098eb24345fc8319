"""Pictures of a cycle for its record: frames with the detected and the predicted cable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, identify
from cell.plan.choose import Choice
from cell.plan.passage import Passage, path_at
from cell.run.findings import Candidates, FilmedMotion, Findings, RehearsedMotion, required
from cell.run.station import Station, Task
from cell.study.data import Trial
from cell.vision.annotation import (
    DESTINATION,
    JAW,
    PREDICTED,
    SEEN,
    WHITE,
    Colour,
    Image,
    difference_inset,
    legend,
    line,
    overlay,
    scale_bar,
    title,
)
from cell.vision.marks import pixels_per_metre


def after_insertion(station: Station, findings: Findings) -> Findings:
    """Draw pictures of hold and execution, and identify the cable again by a complete fit.

    That fit reuses no linearisation from early frames.  The choice was made with the former
    estimate, which stays if the fit is rejected.
    """
    task, trial = station.task, findings.trials[0]
    identified = required(findings.identified)
    passage = passage_pictures(
        required(findings.executed),
        required(findings.candidates),
        findings.predicted_choice,
        required(findings.passage),
        task,
    )
    findings = _with_held_pictures(station, findings).with_pictures(passage)
    try:
        identified = identify(
            trial, task.arc_length_m, task.cable, previous=identified, options=task.identification
        )
    except CableRejectedError:
        return findings
    return replace(findings, identified=identified)


def after_release(station: Station, findings: Findings) -> Findings:
    """Pictures of the hold of a cable that was identified, but is inserted by no offset."""
    if findings.rejected and findings.identified is not None:
        return _with_held_pictures(station, findings)
    return findings


def after_measurement(station: Station, findings: Findings) -> Findings:
    """Pictures of a measuring motion."""
    return findings.with_pictures(measured_pictures(required(findings.held), station.task))


def _with_held_pictures(station: Station, findings: Findings) -> Findings:
    pictures = held_pictures(
        required(findings.held), findings.trials[0], required(findings.identified), station.task
    )
    return findings.with_pictures(pictures)


#: Legend: text and colour of the lines.
_NODES_SEEN = ("nodes seen by the camera", SEEN)
_NODES_OF_MODEL = ("nodes of the identified model", PREDICTED)
_JAW_AXIS = ("axis of the jaw", JAW)


def held_pictures(
    filmed: FilmedMotion, trial: Trial, identified: Identified, task: Task
) -> dict[str, Image]:
    """The hold: at rest before, in the widest swing, and at its end; with the model's nodes."""
    chosen = _chosen(filmed)
    t_s = np.array(sorted({filmed.pictures[i].t_s - filmed.begin_s for i in chosen.values()}))
    nodes_m = simulate(identified.model, trial.grip, t_s, task.arc_length_m)[0]
    images = {}
    for name, i in chosen.items():
        frame = filmed.pictures[i]
        at = int(np.argmin(np.abs(t_s - (frame.t_s - filmed.begin_s))))
        sighting = filmed.sightings[frame.index]
        image = overlay(frame.image, sighting, task.view, nodes_m[at])
        if sighting.seen:
            difference_inset(image, sighting.nodes_m, nodes_m[at], metres_per_pixel(task))
        images[f"identify_{name}"] = _finished(image, task, _NODES_SEEN, _NODES_OF_MODEL, _JAW_AXIS)
    return images


def measured_pictures(filmed: FilmedMotion, task: Task) -> dict[str, Image]:
    """A measuring motion: at rest before, with the tip lowest, and at its end; with detections."""
    return {
        f"measure_{name}": _finished(
            overlay(
                filmed.pictures[i].image, filmed.sightings[filmed.pictures[i].index], task.view
            ),
            task,
            _NODES_SEEN,
            _JAW_AXIS,
        )
        for name, i in _chosen(filmed).items()
    }


def passage_pictures(
    filmed: FilmedMotion, candidates: Candidates, choice: Choice, passage: Passage, task: Task
) -> dict[str, Image]:
    """The execution near the passage: destination, predicted and measured path of the tip.

    The outcome and the forecast's error are written on it; the inset compares, magnified,
    the detected tip with the predicted one, in every frame with the tip inside the destination.
    """
    destination = task.destination
    passes_s = (
        candidates.start_s + choice.t_s[int(np.argmax(choice.tip_m[:, 0] <= destination.x_max_m))]
    )
    frame = min(filmed.pictures, key=lambda p: abs(p.t_s - passes_s))
    image = overlay(frame.image, filmed.sightings[frame.index], task.view)
    sightings = [s for s in filmed.sightings if s.seen]
    measured_m = np.array([s.nodes_m[0] for s in sightings]).reshape(-1, 2)
    t_s = candidates.start_s + choice.t_s
    predicted_m = path_at(np.array([s.t_s for s in sightings]), t_s, choice.tip_m)
    _draw(image, task, destination.corners_m, DESTINATION, closed=True)
    _draw(image, task, measured_m, SEEN)
    _draw(image, task, choice.tip_m, PREDICTED, dashed=True)
    inside = (measured_m[:, 0] <= destination.x_max_m) & (measured_m[:, 0] >= destination.x_min_m)
    difference_inset(image, measured_m[inside], predicted_m[inside], metres_per_pixel(task))
    outcome = "inserted" if passage.passed else f"missed: {passage.reason}"
    error = (
        f"forecast error {passage.error_m * 1e3:.2f} mm, margin {passage.margin_m * 1e3:+z.2f} mm"
    )
    title(image, [("", SEEN), (outcome, SEEN if passage.passed else DESTINATION), (error, WHITE)])
    lines = (
        ("destination", DESTINATION),
        ("cable and path of its tip, measured", SEEN),
        ("path of its tip, predicted (dashed)", PREDICTED),
        _JAW_AXIS,
    )
    return {"execute_passage": _finished(image, task, *lines)}


def metres_per_pixel(task: Task) -> float:
    """Size of a pixel in the plane, at the place where a cable is gripped, m."""
    at_m = np.array([task.home.x_m, task.home.y_m])
    return 1.0 / float(pixels_per_metre(task.view, task.view.to_pixels(at_m)))


def dry_run_pictures(followed: Sequence[RehearsedMotion], task: Task) -> dict[str, Image]:
    """First and last frame of each motion that was filmed: where arm and camera see the gripper.

    Orange, upright cross: the gripping point by the arm, with its way.  Green, slanting: by the
    jaw's marks.  Red: the destination.
    """
    images = {}
    for i, move in enumerate((f for f in followed if f.film is not None), start=1):
        assert move.film is not None
        for name, frame, at in zip(("begin", "end"), move.film.pictures, (0, -1), strict=True):
            image = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
            _draw(image, task, task.destination.corners_m, DESTINATION, closed=True)
            _draw(
                image,
                task,
                np.column_stack([move.gripper_log.x_m, move.gripper_log.y_m]),
                PREDICTED,
            )
            by_arm = move.gripper_log.at(frame.t_s)
            _cross(image, task, np.array([by_arm.x_m, by_arm.y_m]), PREDICTED, upright=True)
            _cross(image, task, move.film.jaw_m[at], SEEN)
            lines = (
                ("destination", DESTINATION),
                ("gripping point and its way, by the arm", PREDICTED),
                ("gripping point, by the camera", SEEN),
            )
            images[f"{i}_{move.name}_{name}"] = _finished(image, task, *lines)
    return images


def _finished(image: Image, task: Task, *lines: tuple[str, Colour]) -> Image:
    """The picture with its legend and scale bar."""
    legend(image, lines)
    scale_bar(image, metres_per_pixel(task))
    return image


def _draw(
    image: Image,
    task: Task,
    line_m: FloatArray,
    colour: Colour,
    *,
    closed: bool = False,
    dashed: bool = False,
) -> None:
    """Draw a line (n, 2) of the plane."""
    if len(line_m):
        line(image, task.view.to_pixels(line_m), colour, 2, closed=closed, dashed=dashed)


def _cross(
    image: Image,
    task: Task,
    at_m: FloatArray,
    colour: Colour,
    *,
    upright: bool = False,
) -> None:
    """Draw a cross at a point of the plane, if it is finite."""
    if np.all(np.isfinite(at_m)):
        arms_m = [[0.007, 0.0], [0.0, 0.007]] if upright else [[0.005, 0.005], [0.005, -0.005]]
        for arm_m in np.array(arms_m):
            _draw(image, task, np.array([at_m - arm_m, at_m + arm_m]), colour)


def _chosen(filmed: FilmedMotion) -> dict[str, int]:
    """Indices of the stored pictures at rest, with the tip lowest, and at the end."""
    tip_y_m = np.array([filmed.sightings[p.index].nodes_m[0, 1] for p in filmed.pictures])
    lowest = int(np.nanargmin(tip_y_m)) if np.isfinite(tip_y_m).any() else 0
    return {"still": 0, "swing": lowest, "held": len(filmed.pictures) - 1}
