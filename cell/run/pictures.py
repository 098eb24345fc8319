"""Pictures of a cycle for its record: what was seen and what the model says, over the frames."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.cable.dynamics import simulate
from cell.identify.identified import Identified
from cell.plan.choose import Choice
from cell.plan.destination import Destination
from cell.run.findings import Candidates, Filmed, Followed
from cell.run.station import Task
from cell.study.data import Trial
from cell.vision.overlay import overlay
from drivers.interfaces import Frame

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

_DESTINATION = (60, 60, 255)  # BGR
_SEEN = (60, 220, 60)
_PREDICTED = (60, 140, 255)


def held_pictures(
    filmed: Filmed, trial: Trial, identified: Identified, task: Task
) -> dict[str, Image]:
    """The hold: at rest before, in the widest swing, and at its end; with the model's nodes."""
    chosen = _chosen(filmed)
    t_s = np.array(sorted({filmed.pictures[i].t_s - filmed.begin_s for i in chosen.values()}))
    nodes_m = simulate(identified.model, trial.grip, t_s, task.arc_length_m)[0]
    images = {}
    for name, i in chosen.items():
        frame = filmed.pictures[i]
        at = int(np.argmin(np.abs(t_s - (frame.t_s - filmed.begin_s))))
        images[f"identify_{name}"] = _drawn(frame, filmed, task, nodes_m[at])
    return images


def measured_pictures(filmed: Filmed, task: Task) -> dict[str, Image]:
    """A measuring motion: at rest before, with the tip lowest, and at its end; what was seen."""
    return {
        f"measure_{name}": _drawn(filmed.pictures[i], filmed, task, None)
        for name, i in _chosen(filmed).items()
    }


def passage_pictures(
    filmed: Filmed, candidates: Candidates, choice: Choice, task: Task
) -> dict[str, Image]:
    """The execution near the passage: destination, predicted and measured path of the tip."""
    destination = task.destination
    passes_s = (
        candidates.start_s + choice.t_s[int(np.argmax(choice.tip_m[:, 0] <= destination.x_max_m))]
    )
    frame = min(filmed.pictures, key=lambda p: abs(p.t_s - passes_s))
    image = overlay(frame.image, filmed.sightings[frame.index], task.view)
    seen_m = np.array([s.nodes_m[0] for s in filmed.sightings if s.seen])
    _draw(image, task, _corners_m(destination), _DESTINATION, closed=True)
    _draw(image, task, choice.tip_m, _PREDICTED)
    _draw(image, task, seen_m, _SEEN)
    return {"execute_passage": image}


def dry_run_pictures(followed: Sequence[Followed], task: Task) -> dict[str, Image]:
    """First and last frame of each motion that was filmed: where arm and camera see the hand.

    Orange, upright cross: the gripping point by the arm, with its way.  Green, slanting: by the
    jaw's marks.  Red: the destination.
    """
    images = {}
    for i, one in enumerate((f for f in followed if f.film is not None), start=1):
        assert one.film is not None
        for name, frame, at in zip(("begin", "end"), one.film.pictures, (0, -1), strict=True):
            image = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
            _draw(image, task, _corners_m(task.destination), _DESTINATION, closed=True)
            _draw(image, task, np.column_stack([one.hand.x_m, one.hand.y_m]), _PREDICTED)
            by_arm = one.hand.at(frame.t_s)
            _cross(image, task, np.array([by_arm.x_m, by_arm.y_m]), _PREDICTED, upright=True)
            _cross(image, task, one.film.jaw_m[at], _SEEN)
            images[f"{i}_{one.name}_{name}"] = image
    return images


def _corners_m(destination: Destination) -> FloatArray:
    return np.array(
        [
            [destination.x_min_m, destination.y_max_m],
            [destination.x_max_m, destination.y_max_m],
            [destination.x_max_m, destination.y_min_m],
            [destination.x_min_m, destination.y_min_m],
        ]
    )


def _draw(
    image: Image,
    task: Task,
    line_m: FloatArray,
    colour: tuple[int, int, int],
    *,
    closed: bool = False,
) -> None:
    """Draw a line (n, 2) of the plane."""
    if len(line_m):
        pixels = np.rint(task.view.to_pixels(line_m) * 16.0).astype(np.int32)
        cv2.polylines(image, [pixels], closed, colour, 2, cv2.LINE_AA, 4)


def _cross(
    image: Image,
    task: Task,
    at_m: FloatArray,
    colour: tuple[int, int, int],
    *,
    upright: bool = False,
) -> None:
    """Draw a cross at a place of the plane, if it is known."""
    if np.all(np.isfinite(at_m)):
        arms_m = [[0.007, 0.0], [0.0, 0.007]] if upright else [[0.005, 0.005], [0.005, -0.005]]
        for arm_m in np.array(arms_m):
            _draw(image, task, np.array([at_m - arm_m, at_m + arm_m]), colour)


def _chosen(filmed: Filmed) -> dict[str, int]:
    """Which of the pictures kept show the cable at rest, with its tip lowest, and at the end."""
    tip_y_m = np.array([filmed.sightings[p.index].nodes_m[0, 1] for p in filmed.pictures])
    lowest = int(np.nanargmin(tip_y_m)) if np.isfinite(tip_y_m).any() else 0
    return {"still": 0, "swing": lowest, "held": len(filmed.pictures) - 1}


def _drawn(frame: Frame, filmed: Filmed, task: Task, nodes_m: FloatArray | None) -> Image:
    return overlay(frame.image, filmed.sightings[frame.index], task.view, nodes_m)
