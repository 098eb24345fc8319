"""A second master of a device is refused, and its owner named; a dead owner's devices are free."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cell.files.input_error import InputError
from cell.settings import Settings, load_settings
from cell.wiring import ownership
from cell.wiring.ownership import devices_of, owned, owned_outputs

ROOT = Path(__file__).parents[3]
EMULATED, FAKE = ROOT / "config" / "emulated.yaml", ROOT / "config" / "fake.yaml"


@pytest.fixture(autouse=True)
def locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which every user may make files, of this test alone."""
    folder = tmp_path / "lock"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr(ownership, "_FOLDERS", (folder,))
    monkeypatch.setattr(ownership, "_DYING_S", 0.3)
    return folder


def settings_of(**changes: dict[str, Any]) -> Settings:
    """An emulated cell with other devices: section → entries."""
    data = load_settings(EMULATED).model_dump(mode="json")
    data["arm"]["host"] = "127.0.0.251"
    for section, entries in changes.items():
        data[section] |= entries
    return Settings.model_validate(data)


def refused(settings: Settings) -> str:
    with pytest.raises(InputError) as error, owned(settings, EMULATED):
        pass
    return str(error.value)


OTHERS = {
    "arm": {"host": "127.0.0.252"},
    "camera": {"device": "tcp://127.0.0.252:5600"},
    "gripper": {"port": "/tmp/cable-cell-another"},
}


@pytest.mark.parametrize("shared", ["arm", "camera", "gripper"])
def test_one_device_in_common_is_enough_to_be_refused(shared: str) -> None:
    another = settings_of(**{k: v for k, v in OTHERS.items() if k != shared})
    with owned(settings_of(), EMULATED):
        said = refused(another)
        assert f": {devices_of(another)[0].key.replace('arm', shared).partition('.')[0]}." in said
        assert re.search(rf"in use by process {os.getpid()}, since \d{{4}}-\d\d-\d\d \d\d:", said)
        assert said.endswith("; end that program, or let it finish")
        with owned(settings_of(**OTHERS), EMULATED):  # nothing in common
            pass
    with owned(another, EMULATED):  # what was refused holds nothing
        pass


def test_the_command_of_the_owner_is_named_and_its_death_frees_the_devices(locks: Path) -> None:
    program = (
        "import sys, time\nfrom pathlib import Path\n"
        "from cell.settings import load_settings\nfrom cell.wiring import ownership\n"
        "ownership._FOLDERS = (Path(sys.argv[2]),)\n"
        "config = Path(sys.argv[1])\n"
        "with ownership.owned(load_settings(config), config):\n"
        "    print('owns', flush=True)\n    time.sleep(600)\n"
    )
    words = [sys.executable, "-c", program, str(EMULATED), str(locks)]
    first = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None and first.stdout.readline() == "owns\n"
    settings = load_settings(EMULATED)
    said = refused(settings)
    assert f"process {first.pid}, since" in said and str(EMULATED) in said
    first.kill()
    first.communicate()
    with owned(settings, EMULATED):
        assert f"process {os.getpid()}" in refused(settings)


def test_a_device_is_the_same_by_all_its_names(tmp_path: Path) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    (tmp_path / "by-id").symlink_to(port)
    one, two = (
        settings_of(arm={"host": host}, camera={"device": device}, gripper={"port": str(path)})
        for host, device, path in (
            ("localhost", 0, port),
            ("127.0.0.1", "/dev/video0", tmp_path / "by-id"),
        )
    )
    assert devices_of(one) == devices_of(two)


def test_simulated_devices_need_no_owner(locks: Path) -> None:
    fake = load_settings(FAKE)
    with owned(fake, FAKE), owned(fake, FAKE):
        assert list(locks.iterdir()) == []


def test_outputs_of_a_controller_have_an_owner_of_their_own() -> None:
    settings = settings_of()
    with owned(settings, EMULATED), owned_outputs("127.0.0.251", EMULATED):
        with pytest.raises(InputError) as error, owned_outputs("127.0.0.251", EMULATED):
            pass
        assert "plant.handshake: digital outputs of 127.0.0.251: in use" in str(error.value)
        assert "arm 127.0.0.251: in use" in refused(settings)


def test_what_an_owner_has_not_written_yet_is_waited_for() -> None:
    """A lock that was just taken still had the name of the owner before, or none."""
    settings = settings_of()
    with owned(settings, EMULATED):
        devices_of(settings)[0].lock.write_text("")
        assert ": in use by another program; end" in refused(settings)
