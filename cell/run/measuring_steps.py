"""The steps that measure a cable in a motion, or in a film made without this cell."""

from __future__ import annotations

from dataclasses import replace

from cell.plan.measuring import Measuring, measuring_path
from cell.records.result import Outcome
from cell.run.filming import capture, film
from cell.run.findings import Filming, Findings, required
from cell.run.movements import APPROACH_SLOWER
from cell.run.station import Station
from cell.run.steps import KEEP_EVERY_HELD, move_to
from cell.run.trials import held_trial
from cell.run.waiting import wait_until
from cell.vision.sighting import why_unseen

#: Share of a measuring motion's frames in which the cable must be detected.
MIN_DETECTED = 0.8


def approach(motion: Measuring, station: Station, findings: Findings) -> Findings:
    """Bring the cable slowly to where a measuring motion begins, and let it calm down."""
    move_to(station, motion.start, station.task.insertion.slowed(APPROACH_SLOWER))
    wait_until(station, station.devices.clock.now_s() + station.task.calm_s)
    return findings


def measure(motion: Measuring, station: Station, findings: Findings) -> Findings:
    """Film the cable at rest, during the moves and while the gripper is held after them."""
    path = measuring_path(motion.start, motion.moves, station.devices.arm.rate_hz)
    filming = film(station, path, motion.still_s, motion.hold_s, KEEP_EVERY_HELD)
    held = capture(station, filming, KEEP_EVERY_HELD)
    trial = replace(held_trial(held), name=motion.name)
    findings = replace(findings, held=held, trials=(trial,), outcome=Outcome.MEASURED)
    detected = sum(s.seen for s in held.sightings)
    if detected >= MIN_DETECTED * len(held.sightings):
        return findings
    why = why_unseen(held.sightings, station.task.vision.free_length_m)
    return findings.reject(
        f"the cable is seen in {detected} of {len(held.sightings)} frames, needs "
        f"{MIN_DETECTED:.0%}; keep the motion inside the picture; {why}"
    )


def begin_film(filming: Filming, station: Station, findings: Findings) -> Findings:
    """Start the camera on a film whose motion this cell has not made."""
    station.devices.camera.start(filming.frame_count)
    return replace(findings, filming=filming)


def detect_in_film(station: Station, findings: Findings) -> Findings:
    """Detect the cable in every frame of a film; no decision follows."""
    held = capture(station, required(findings.filming), KEEP_EVERY_HELD)
    return replace(findings, held=held, trials=(held_trial(held),))


def conclude(station: Station, findings: Findings) -> Findings:
    """Set the outcome of a film whose cable was identified: measured, nothing is executed."""
    return replace(findings, outcome=Outcome.MEASURED)
