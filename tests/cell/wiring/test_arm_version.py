"""A controller whose version is not proved moves cables only after a dry run at low speed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.files.input_error import InputError
from cell.records.result import Outcome, Result
from cell.settings import Settings, load_settings
from cell.wiring.arm_version import FILE, check_arm_version, passed_dry_runs, remember_dry_run
from drivers.emulators.launch import EmulatedController

EMULATED = Path(__file__).parents[3] / "config" / "emulated.yaml"
CONFIG = Path("yours.yaml")


@pytest.fixture(scope="module")
def controller() -> Iterator[EmulatedController]:
    worker = os.getpid() % 60000
    with EmulatedController(f"127.{90 + worker // 250 % 30}.{1 + worker % 250}.7") as emulator:
        yield emulator


def settings(controller: EmulatedController, allow: str | None) -> Settings:
    loaded = load_settings(EMULATED)
    arm = loaded.arm.model_copy(update={"host": controller.host, "allow_version": allow})
    return loaded.model_copy(update={"arm": arm})


def rehearsed(speed: float, outcome: Outcome = Outcome.REHEARSED) -> Result:
    return Result(cycle=1, outcome=outcome, folder="runs/a-1", speed=speed)


@pytest.mark.parametrize("version", ["5.26.0.9", "10.13.0.9"])
def test_cables_wait_for_a_dry_run_at_low_speed(
    controller: EmulatedController, tmp_path: Path, version: str
) -> None:
    controller.request("version", version=version)
    given = settings(controller, ".".join(version.split(".")[:2]))
    with pytest.raises(InputError) as refused:
        check_arm_version(given, CONFIG, tmp_path, None)
    assert "arm.allow_version" in str(refused.value) and version in str(refused.value)
    command = f"cell run --config yours.yaml --runs {tmp_path} --dry-run --speed 0.1"
    assert command in str(refused.value)
    with pytest.raises(InputError, match=r"at most 0\.25"):
        check_arm_version(given, CONFIG, tmp_path, 0.5)
    check_arm_version(given, CONFIG, tmp_path, 0.25)

    remember_dry_run(given, tmp_path, [rehearsed(0.5), rehearsed(0.1, Outcome.UNFIT)])
    assert passed_dry_runs(tmp_path) == ()
    remember_dry_run(given, tmp_path, [rehearsed(0.1)])
    (passed,) = passed_dry_runs(tmp_path)
    assert (passed.version, passed.host, passed.speed) == (version, controller.host, 0.1)
    assert passed.serial_number == ("20225500001" if version.startswith("5.") else None)
    check_arm_version(given, CONFIG, tmp_path, None)
    check_arm_version(given, CONFIG, tmp_path, 1.0)

    controller.request("version", version=version[:-1] + "10")  # an update: tried anew
    with pytest.raises(InputError, match="is not proved"):
        check_arm_version(given, CONFIG, tmp_path, None)


def test_nothing_is_asked_of_proved_versions_and_of_those_that_the_driver_refuses(
    controller: EmulatedController, tmp_path: Path
) -> None:
    controller.request("version", version="5.12.2.1")
    for allowed in (None, "5.12", "5.26"):
        check_arm_version(settings(controller, allowed), CONFIG, tmp_path, None)
    controller.request("version", version="5.26.0.1")
    for allowed in (None, "5.25"):  # the driver refuses it, with its own words
        check_arm_version(settings(controller, allowed), CONFIG, tmp_path, None)
    remember_dry_run(settings(controller, None), tmp_path, [rehearsed(0.1)])
    assert not (tmp_path / FILE).exists()


def test_a_torn_file_is_no_permission(controller: EmulatedController, tmp_path: Path) -> None:
    controller.request("version", version="5.26.0.1")
    for torn in ("[", "{}", '[{"version": "5.26.0.1"}]', "[3]", "null"):
        (tmp_path / FILE).write_text(torn)
        with pytest.raises(InputError, match="is not proved"):
            check_arm_version(settings(controller, "5.26"), CONFIG, tmp_path, None)


def test_a_controller_that_does_not_answer_yet_must_have_been_tried(
    controller: EmulatedController, tmp_path: Path
) -> None:
    """A service that is started before it connects much later, and asks nobody again."""
    silent = settings(controller, "5.26").model_copy(
        update={"arm": settings(controller, "5.26").arm.model_copy(update={"host": "127.0.0.77"})}
    )
    with pytest.raises(InputError, match=r"5\.26 at 127\.0\.0\.77, which does not answer"):
        check_arm_version(silent, CONFIG, tmp_path, None)
    check_arm_version(silent, CONFIG, tmp_path, 0.1)
    controller.request("version", version="5.26.0.9")
    remember_dry_run(settings(controller, "5.26"), tmp_path, [rehearsed(0.1)])
    with pytest.raises(InputError, match="does not answer"):
        check_arm_version(silent, CONFIG, tmp_path, None)  # that was another one
    file = tmp_path / FILE
    file.write_text(file.read_text().replace(controller.host, silent.arm.host))
    check_arm_version(silent, CONFIG, tmp_path, None)


@pytest.mark.parametrize(
    ("given", "said"), [("5.20", "write the version in quotes"), ('"5"', "match"), ('"10.x"', "m")]
)
def test_a_version_is_written_as_text(tmp_path: Path, given: str, said: str) -> None:
    path = tmp_path / "cell.yaml"
    text = EMULATED.read_text(encoding="utf-8")
    path.write_text(text.replace("\narm:", f"\narm:\n  allow_version: {given}"))
    with pytest.raises(InputError, match=rf"arm\.allow_version.*{said}"):
        load_settings(path)
