"""Permits a controller with an unproved version: by an entry in the settings and a slow dry run.

`arm.allow_version` names the version.  The first dry run at low speed with that controller is
stored in the folder of the records; without one, no cable is moved.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from cell.files.atomic import write_atomic
from cell.files.input_error import InputError
from cell.records.result import Outcome, Result
from cell.settings import Settings
from cell.settings import devices as device_settings
from drivers.ur_versions import ControllerIdentity, identify, is_proved, refusal, version_text

#: In the folder of the records.
FILE = "allowed_versions.json"
#: Largest speed of such a dry run, as a share of the full speed.
MOST_SPEED = 0.25


@dataclass(frozen=True)
class PassedDryRun:
    """A dry run without errors, with a controller whose version is not proved.

    host           address of the controller
    serial_number  None = not reported, as by PolyScope X: the address identifies it then
    speed          share of the full speed
    time           UTC, ISO 8601
    folder         of the record of the dry run
    """

    version: str
    host: str
    serial_number: str | None
    speed: float
    time: str
    folder: str

    def is_of(self, controller: ControllerIdentity, host: str) -> bool:
        """Whether it was made with this controller and the same version."""
        same = self.version == controller.version_text
        if controller.serial_number is not None:
            return same and self.serial_number == controller.serial_number
        return same and self.serial_number is None and self.host == host


def check_arm_version(settings: Settings, config: Path, runs: Path, speed: float | None) -> None:
    """Check that the controller's version is proved, or has passed a dry run at low speed.

    The driver refuses a refused controller itself.  One that does not answer yet may do so when a
    service connects to it: a dry run at its address must have passed with the version.

    speed   of the dry run that is to be made; None = a cable is to be moved
    raises  InputError: neither; with the command of the dry run
    """
    arm = settings.arm
    if speed is not None and speed <= MOST_SPEED:
        return
    if not isinstance(arm, device_settings.UrArmSettings) or arm.allowed_version is None:
        return
    if is_proved(arm.allowed_version):
        return
    dry_runs = passed_dry_runs(runs)
    try:
        controller = _unproved(settings)
    except OSError as error:
        release = f"{version_text(arm.allowed_version)}."
        if any(str(p.version).startswith(release) and p.host == arm.host for p in dry_runs):
            return
        version = f"{arm.allow_version} at {arm.host}, which does not answer ({error})"
    else:
        if controller is None or any(run.is_of(controller, arm.host) for run in dry_runs):
            return
        version = f"{controller.version_text} at {arm.host}"
    raise InputError.at(
        config,
        f"{arm.allow_version} is not proved: no dry run at a speed of at most {MOST_SPEED:g} has "
        f"passed with PolyScope {version}, as far as {runs / FILE} says; "
        f"empty the jaws, then: cell run --config {config} --runs {runs} --dry-run --speed 0.1",
        key="arm.allow_version",
    )


def remember_dry_run(settings: Settings, runs: Path, results: Sequence[Result]) -> None:
    """Store that a dry run has passed, if `check_arm_version` needs it.

    raises  OSError: it cannot be written
    """
    for result in results:
        slow = result.speed is not None and result.speed <= MOST_SPEED
        if result.outcome is not Outcome.REHEARSED or not slow:
            continue
        controller = None
        with suppress(OSError):
            controller = _unproved(settings)
        if controller is not None:
            assert (
                isinstance(settings.arm, device_settings.UrArmSettings) and result.speed is not None
            )
            passed = PassedDryRun(
                controller.version_text,
                settings.arm.host,
                controller.serial_number,
                result.speed,
                datetime.now(UTC).isoformat(timespec="seconds"),
                result.folder,
            )
            everything = [asdict(run) for run in (*passed_dry_runs(runs), passed)]
            write_atomic(runs / FILE, json.dumps(everything, indent=2) + "\n")


def passed_dry_runs(runs: Path) -> tuple[PassedDryRun, ...]:
    """Dry runs stored in `runs`; none if the file is missing or invalid."""
    with suppress(OSError, ValueError, TypeError):
        text = (runs / FILE).read_text(encoding="utf-8")
        return tuple(PassedDryRun(**entry) for entry in json.loads(text))
    return ()


def _unproved(settings: Settings) -> ControllerIdentity | None:
    """The controller, if it runs a version that is allowed by the settings alone.

    raises  OSError: it does not answer
    """
    arm = settings.arm
    if not isinstance(arm, device_settings.UrArmSettings) or arm.allow_version is None:
        return None
    controller = identify(arm.host)
    refused = refusal(controller.release, arm.allowed_version) is not None
    return None if refused or is_proved(controller.release) else controller
