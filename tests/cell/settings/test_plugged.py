"""Devices of other packages: the gripper of docs/howto/extend.md, installed from a folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cell.files.input_error import InputError
from cell.settings import load_settings
from cell.settings.loading import for_product
from cell.settings.plugged import settings_class
from cell.wiring.build import real_devices
from cell.wiring.ownership import devices_of
from drivers.interfaces import DeviceLostError, Gripper

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "howto" / "extend.md").read_text("utf-8")
EXAMPLE = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0]
OURS = "'sim', 'serial', 'urcap'"


def installed(folder, source, entry="gripper.acme = acme_gripper:AcmeGripper"):
    """A package as pip leaves it: its module, and what it registers."""
    (folder / "acme_gripper.py").write_text(source, encoding="utf-8")
    about = folder / "acme_gripper-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-gripper\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[cable_cell.devices]\n{entry}\n", encoding="utf-8")
    return folder


@pytest.fixture
def config(tmp_path):
    """The line's settings with Acme's gripper; and the line on which its kind stands."""
    text = (ROOT / "config" / "line3.yaml").read_text("utf-8")
    text, count = re.subn(r"kind: serial\n  port: \S+", "kind: acme\n  host: 10.0.0.20", text)
    assert count == 1
    path = tmp_path / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return path, next(i for i, row in enumerate(text.splitlines(), 1) if "kind: acme" in row)


@pytest.fixture
def package(tmp_path, monkeypatch):
    def install(source=EXAMPLE, **entry):
        folder = tmp_path / "site"
        folder.mkdir()
        monkeypatch.syspath_prepend(str(installed(folder, source, **entry)))
        return folder

    yield install
    sys.modules.pop("acme_gripper", None)


def refused(path):
    with pytest.raises(InputError) as said:
        load_settings(path)
    (problem,) = said.value.problems
    return str(problem)


def test_cell_check_takes_an_installed_device(config, tmp_path):
    path, line = config
    site = tmp_path / "site"
    site.mkdir()

    def check():
        command = [sys.executable, "-m", "cell", "check", "--config", str(path)]
        env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(site)])}
        return subprocess.run(command, capture_output=True, text=True, env=env, check=False)

    without = check()
    assert without.returncode == 2
    said = f"{path}:{line}:3: gripper.kind: 'acme' is not one of {OURS}"
    assert said in without.stderr
    assert "install the package that has this gripper (`cell help extend`)" in without.stderr
    installed(site, EXAMPLE)
    done = check()
    assert done.returncode == 0, done.stderr
    assert all(line.startswith("note: ") for line in done.stderr.splitlines())
    assert "arm ur, camera genicam, gripper acme" in done.stdout


def test_the_device_is_built_and_has_one_owner(config, package):
    package()
    settings = load_settings(config[0])
    gripper = real_devices(settings).gripper
    assert isinstance(gripper, Gripper)
    gripper.connect()
    assert gripper.grip(20.0).holding
    assert not gripper.release().holding
    assert [(d.key, d.name) for d in devices_of(settings)][-1] == (
        "gripper.kind",
        "gripper acme 10.0.0.20",
    )


def test_the_example_behaves_as_a_gripper_must(config, tmp_path):
    """By the conformance suite, as the page says; two of its tests failed."""
    site = tmp_path / "site"
    site.mkdir()
    installed(site, EXAMPLE)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--hardware",
               "--config", str(config[0]), "tests/drivers/conformance", "-kgripper"]  # fmt: skip
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(site)])}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=env, check=False)
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


def test_an_error_of_a_drivers_own_is_a_fault_of_its_device(config, package):
    """It ended the program with its bare text, before the cycle had a result."""
    package(
        EXAMPLE.replace(
            "        opening_m =", "        raise OSError('line broken')\n        opening_m ="
        )
    )
    gripper = real_devices(load_settings(config[0])).gripper
    for act in (gripper.state, gripper.release):
        with pytest.raises(DeviceLostError, match="not connected"):
            act()
    gripper.connect()
    with pytest.raises(DeviceLostError) as raised:
        gripper.state()
    fault = raised.value
    assert (fault.device, fault.cause) == (
        "gripper",
        "its driver failed in `state`: OSError: line broken",
    )
    assert "correct the driver, then reset" in fault.remedy


def test_settings_of_a_record_are_read_back(config, package):
    package()
    settings = load_settings(config[0])
    data = settings.model_dump(mode="json")
    assert settings_class(data).model_validate(data).gripper == settings.gripper
    assert type(settings) is not type(settings).__base__
    with pytest.raises(ValueError, match="no product"):
        for_product(settings, "none")


def test_entries_of_the_device_are_checked(config, package):
    package()
    path, line = config
    path.write_text(path.read_text("utf-8").replace("  host: 10", "  hosts: 10"), encoding="utf-8")
    assert refused(path).startswith(f"{path}:{line + 1}:3: gripper.hosts: ")
    assert "did you mean 'host'?" in refused(path)


def test_other_mistakes_are_told_with_an_unknown_kind(config):
    path, _ = config
    path.write_text(path.read_text("utf-8").replace("min_probability: 0.9", "min_probability: 9.0"))
    with pytest.raises(InputError) as said:
        load_settings(path)
    assert {p.key for p in said.value.problems} == {"gripper.kind", "choice.min_probability"}


@pytest.mark.parametrize(
    ("source", "entry", "said"),
    [
        ("import nothing_there", {}, "the package acme-gripper does not load: ModuleNotFoundError"),
        (EXAMPLE.replace("def release", "def let_go"), {}, "lacks release of a gripper; add it"),
        (
            EXAMPLE.replace("settings_class =", "other ="),
            {},
            "`settings_class` derived from Plugged",
        ),
        (EXAMPLE, {"entry": "gripper.acne = acme_gripper:AcmeGripper"}, "did you mean 'acne'?"),
        (EXAMPLE, {"entry": "camera.acme = acme_gripper:AcmeGripper"}, f"not one of {OURS}"),
    ],
)
def test_a_package_that_cannot_be_used_is_named(config, package, source, entry, said):
    package(source, **entry)
    path, line = config
    found = refused(path)
    assert found.startswith(f"{path}:{line}:3: gripper.kind: ")
    assert said in found
