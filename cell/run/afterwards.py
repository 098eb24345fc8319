"""Work on a cycle's findings after a step, when the hand need not wait: pictures, final fit."""

from __future__ import annotations

from dataclasses import replace

from cell.identify.individual import CableRejectedError, identify
from cell.records.result import Outcome
from cell.run.agreement import agreement
from cell.run.findings import Findings, required
from cell.run.pictures import dry_run_pictures, held_pictures, measured_pictures, passage_pictures
from cell.run.station import Station


def after_insertion(station: Station, findings: Findings) -> Findings:
    """Pictures of hold and execution, and the same cable identified again without haste.

    No step of that fit is left linear from early frames.  The choice was made with the cable as it
    was, which stays if the fit finds nothing better.
    """
    task, trial = station.task, findings.trials[0]
    identified = required(findings.identified)
    passage = passage_pictures(
        required(findings.executed),
        required(findings.candidates),
        findings.foretold,
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
    """Pictures of the hold of a cable that was identified, but that no offset can insert."""
    if findings.rejected and findings.identified is not None:
        return _with_held_pictures(station, findings)
    return findings


def after_measurement(station: Station, findings: Findings) -> Findings:
    """Pictures of a measuring motion."""
    return findings.with_pictures(measured_pictures(required(findings.held), station.task))


def after_dry_run(station: Station, findings: Findings) -> Findings:
    """Whether arm and camera agree, with pictures, and whether everything is as it must be."""
    arm, camera = station.devices.arm, station.devices.camera
    checks = findings.checks + agreement(
        findings.followed, lag_s=arm.lag_s, frame_rate_hz=camera.frame_rate_hz
    )
    findings = replace(findings, checks=checks, outcome=Outcome.REHEARSED).with_pictures(
        dry_run_pictures(findings.followed, station.task)
    )
    wrong = [check.what for check in checks if not check.right]
    if wrong:
        reason = f"not as it must be: {', '.join(wrong)}"
        findings = replace(findings, outcome=Outcome.UNFIT, reason=reason)
    return findings


def _with_held_pictures(station: Station, findings: Findings) -> Findings:
    pictures = held_pictures(
        required(findings.held), findings.trials[0], required(findings.identified), station.task
    )
    return findings.with_pictures(pictures)
