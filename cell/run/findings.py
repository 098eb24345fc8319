"""Findings of a cycle so far, passed from step to step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.identify.identified import Identified
from cell.identify.predicted_frames import PredictedFrames
from cell.plan.choose import Choice, Forecast
from cell.plan.correction import Tail
from cell.plan.passage import Passage
from cell.records.result import AgreementCheck, Outcome
from cell.study.data import Trial
from cell.vision.sighting import Sighting
from drivers.interfaces import Frame, Trajectory

Image = NDArray[np.uint8]

Value = TypeVar("Value")


@dataclass(frozen=True)
class Filming:
    """A motion that is being filmed.

    It began at `begin_s`, the gripper rests from `rest_s`, and it is filmed until `end_s`;
    sightings and pictures are those of the frames so far.  `delay_s` is the least time so far from
    a frame's exposure until it was read, s: a frame with a longer one has waited.
    """

    begin_s: float
    rest_s: float
    end_s: float
    frame_count: int
    sightings: tuple[Sighting, ...] = ()
    pictures: tuple[Frame, ...] = field(default=(), repr=False)
    delay_s: float = float("inf")


@dataclass(frozen=True, eq=False)
class Candidates:
    """All offsets simulated as if their paths began at `start_s`; paths in the arm's own frame."""

    start_s: float
    paths: tuple[Trajectory, ...]
    forecast: Forecast


@dataclass(frozen=True, eq=False)
class EarlyEstimate:
    """The cable identified from the first frames of a hold, and simulations with it.

    predicted   forecast for the frames to come
    enough      whether more frames would not matter, see `enough_frames`
    """

    identified: Identified
    predicted: PredictedFrames
    candidates: Candidates
    enough: bool = False


@dataclass(frozen=True)
class FilmedMotion:
    """A motion that was filmed, on the cell's clock.

    begin_s     when filming began
    sightings   one per frame
    gripper_log  measured poses, from before the first frame to after the last
    pictures    a few of the frames, for the record
    last_frame_at_s  when the last frame was taken, by the computer's own clock
    early       estimate computed during the filming, if any
    """

    begin_s: float
    sightings: tuple[Sighting, ...]
    gripper_log: Trajectory
    pictures: tuple[Frame, ...] = field(repr=False)
    last_frame_at_s: float
    early: EarlyEstimate | None = None


@dataclass(frozen=True, eq=False)
class JawFilm:
    """The jaw as detected by the camera during a motion.

    frame_s     (n,) times of all frames
    sampled_s   (m,) times of those in which the jaw was searched
    jaw_m       (m, 2) detected gripping point, nan = not detected
    pictures    the first and the last frame
    """

    frame_s: FloatArray
    sampled_s: FloatArray
    jaw_m: FloatArray
    pictures: tuple[Frame, Frame]


@dataclass(frozen=True, eq=False)
class RehearsedMotion:
    """A motion of a dry run, on the cell's clock.

    start_s  commanded start of the arm
    gripper_log  measured poses, from before the motion to after it
    film     None = not filmed
    """

    name: str
    path: Trajectory
    start_s: float
    gripper_log: Trajectory
    film: JawFilm | None


@dataclass(frozen=True, eq=False)
class Findings:
    """The results of a cycle's steps so far; None = not yet computed.

    filming     the motion that is being filmed
    held        the hold after the cable was lowered, or a complete measuring motion
    trials      the filmed motions, as recorded
    identified  the cable
    hold_saved_s     longest hold minus the actual one
    lead_s      time from now to the start of a motion chosen now
    simulated_s  when each simulation of the offsets began, on the cell's clock
    waiting_since_s   since when the gripper waits for the computer, by the computer's own clock
    wait_s      its waiting time until the choice
    offset_m    of the choice that is executed
    executed    the execution
    stopped     why the gripper was brought to rest in front of the opening; None = it was not
    stops       the same of earlier tries with this cable; their trials
    tails       changes of its path that were commanded in flight; None = without feedback
    predicted   (T,) times from when the path began, and (T, 2) tip as last predicted in flight
    followed    movements of a dry run
    speed       of a dry run, as a share of the full one
    checks      of the devices, by a dry run or the clocks
    outcome     how the cycle ends if nothing fails from here on
    reason      why it does not end well, in words
    pictures    for the record: name → (H, W, 3), blue first
    """

    filming: Filming | None = None
    held: FilmedMotion | None = None
    trials: tuple[Trial, ...] = ()
    identified: Identified | None = None
    hold_saved_s: float | None = None
    lead_s: float | None = None
    simulated_s: tuple[float, ...] = ()
    waiting_since_s: float | None = None
    candidates: Candidates | None = None
    choice: Choice | None = None
    wait_s: float | None = None
    offset_m: float | None = None
    executed: FilmedMotion | None = None
    stopped: str | None = None
    stops: tuple[str, ...] = ()
    earlier: tuple[Trial, ...] = ()
    tails: tuple[Tail, ...] | None = None
    predicted: tuple[FloatArray, FloatArray] | None = None
    passage: Passage | None = None
    followed: tuple[RehearsedMotion, ...] = ()
    speed: float | None = None
    checks: tuple[AgreementCheck, ...] = ()
    outcome: Outcome | None = None
    reason: str | None = None
    pictures: Mapping[str, Image] = field(default_factory=dict)

    @property
    def rejected(self) -> bool:
        """Whether this cable is not inserted, or its measurement not used."""
        return self.outcome is Outcome.REJECTED

    @property
    def predicted_choice(self) -> Choice:
        """The choice, with the tip's path as it was last predicted."""
        choice = required(self.choice)
        if self.predicted is None:
            return choice
        return replace(choice, t_s=self.predicted[0], tip_m=self.predicted[1])

    @property
    def decided(self) -> bool:
        """Whether the cable is rejected or an offset is chosen."""
        return self.rejected or self.offset_m is not None

    def reject(self, reason: str) -> Findings:
        """The same with the cable rejected."""
        return replace(self, outcome=Outcome.REJECTED, reason=reason)

    def for_retry(self) -> Findings:
        """Findings for a further try with the same cable: trials, pictures and checks stay."""
        name = f"try_{len(self.stops) + 1}"
        trials = (replace(t, name=f"{t.name}_{name}", role="validate") for t in self.trials)
        return Findings(
            stops=(*self.stops, required(self.stopped)),
            earlier=(*self.earlier, *trials),
            speed=self.speed,
            checks=self.checks,
            pictures={
                known if known.startswith("try_") else f"{name}_{known}": picture
                for known, picture in self.pictures.items()
            },
        )

    def with_pictures(self, pictures: Mapping[str, Image]) -> Findings:
        """The same with more pictures."""
        return replace(self, pictures={**self.pictures, **pictures})


def required(value: Value | None) -> Value:
    """The finding of an earlier step, checked to exist.

    raises  LookupError: no earlier step adds it; the plan's order is wrong
    """
    if value is None:
        raise LookupError("a step needs what no step before it in the plan has found")
    return value
