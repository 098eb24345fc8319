"""Locks that give one program at a time the right to command a cell's devices.

Each device has a lock of the operating system, by its address.  All users of the computer share
them, and the system frees them when their owner ends, however it ends.  An arm is also claimed at
its controller, by `drivers.ur_claim`: programs on other computers see that.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from cell.files.input_error import InputError
from cell.settings import Settings
from cell.settings import devices as device_settings
from cell.settings.plugged import place_of
from drivers.ur_claim import COMMANDS, ClaimedError, claim

#: Folders that may hold the locks: the first in which every user may make files.
_FOLDERS = (Path("/run/lock"), Path("/tmp"))
#: Longest wait for a killed owner, which still stops its arm, and polling interval, s.
_DYING_S, _POLL_S = 3.0, 0.05
_REMEDY = "end that program, or let it finish"


@dataclass(frozen=True)
class Device:
    """A device that one program may own.

    key   of the settings that has its address
    name  kind and address: the same in all programs
    """

    key: str
    name: str

    @property
    def lock(self) -> Path:
        """File whose lock the owner holds."""
        marks = hashlib.sha256(self.name.encode()).hexdigest()[:16]
        return _folder() / f"cable-cell-{marks}.lock"


@dataclass(frozen=True)
class Owner:
    """A program that owns a device.

    since  local time
    """

    pid: int
    since: str
    command: str

    def __str__(self) -> str:
        return f"process {self.pid}, since {self.since}: {self.command}"


class _OwnedError(Exception):
    """A device has an owner; `pid` of its process on this computer, None = not known."""

    def __init__(self, device: Device, message: str, pid: int | None) -> None:
        super().__init__(message)
        self.device = device
        self.pid = pid


@contextmanager
def owned(settings: Settings, config: Path) -> Iterator[None]:
    """Own arm, camera and gripper of a cell within the `with`; simulated ones need no owner.

    raises  InputError: another program commands one of them, with its process and the remedy
    """
    host = settings.arm.host if isinstance(settings.arm, device_settings.UrArmSettings) else None
    with _own(devices_of(settings), host, config):
        yield


@contextmanager
def owned_outputs(host: str, config: Path) -> Iterator[None]:
    """Own the digital outputs of a controller within the `with`; its arm may be another's.

    raises  InputError: another program sets them, with its process and the remedy
    """
    with _own([Device("plant.handshake", f"digital outputs of {_address(host)}")], None, config):
        yield


def devices_of(settings: Settings) -> list[Device]:
    """The real and emulated devices of a cell, arm first."""
    arm, camera, gripper = settings.arm, settings.camera, settings.gripper
    devices = []
    if isinstance(arm, device_settings.UrArmSettings):
        devices.append(Device("arm.host", f"arm {_address(arm.host)}"))
    match camera:
        case device_settings.OpenCvCameraSettings():
            path = camera.device
            path = f"/dev/video{path}" if isinstance(path, int) else path
            devices.append(Device("camera.device", f"camera {_place(path)}"))
        case device_settings.GenicamCameraSettings():
            which = camera.serial_number or f"of {camera.producer.resolve()}"
            devices.append(Device("camera.serial_number", f"camera {which}"))
    match gripper:
        case device_settings.SerialGripperSettings():
            devices.append(Device("gripper.port", f"gripper on {_place(gripper.port)}"))
        case device_settings.UrcapGripperSettings():
            place = f"{_address(gripper.host)}:{gripper.port}"
            devices.append(Device("gripper.host", f"gripper on {place}"))
    for name, section in (("arm", arm), ("camera", camera), ("gripper", gripper)):
        if (foreign := place_of(section)) is not None:
            devices.append(Device(f"{name}.kind", f"{name} {foreign}"))
    return devices


def _address(host: str) -> str:
    """The IP address of a host, as far as it is known: an arm may be called by both."""
    try:
        return str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0])
    except OSError:
        return host.lower()


def _place(device: str) -> str:
    """A device's own path, whatever links lead to it; an URL is its own."""
    return device if "://" in device else os.path.realpath(device)


@contextmanager
def _own(devices: list[Device], host: str | None, config: Path) -> Iterator[None]:
    """Own all devices, and check that no other program commands the controller at `host`."""
    until_s = time.monotonic() + _DYING_S
    with ExitStack() as owning:
        while True:
            try:
                for device in devices:
                    _lock(device, owning)
                if host is not None:
                    _check_unclaimed(devices[0], host)
                break
            except _OwnedError as error:
                owning.close()
                if _runs(error.pid) or time.monotonic() > until_s:
                    raise InputError.at(config, str(error), key=error.device.key) from error
                time.sleep(_POLL_S)
        yield


def _lock(device: Device, owning: ExitStack) -> None:
    """Hold a device's lock until the end of `owning`.  Raises _OwnedError."""
    descriptor = _opened(device.lock)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = _owner(descriptor)
        os.close(descriptor)
        who = "another program" if owner is None else str(owner)
        raise _OwnedError(
            device,
            f"{device.name}: in use by {who}; {_REMEDY}",
            None if owner is None else owner.pid,
        ) from None
    owning.callback(os.close, descriptor)
    since, command = time.strftime("%Y-%m-%d %H:%M:%S"), shlex.join([_program(), *sys.argv[1:]])
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, json.dumps(asdict(Owner(os.getpid(), since, command))).encode(), 0)


def _opened(path: Path) -> int:
    """A file that every user may lock; it is never deleted, or two could hold its lock."""
    while True:
        try:
            return os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            pass
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            descriptor = os.open(path, flags, 0o600)
        except FileExistsError:  # another program was faster
            continue
        os.fchmod(descriptor, 0o666)
        return descriptor


def _owner(descriptor: int) -> Owner | None:
    """Holder of a lock; None = nothing is written yet."""
    try:
        return Owner(**json.loads(os.pread(descriptor, 65536, 0)))
    except (ValueError, TypeError):
        return None


def _check_unclaimed(arm: Device, host: str) -> None:
    """Raises _OwnedError: another program commands the controller; no answer means none does."""
    try:
        claim(host, os.getpid(), [COMMANDS]).close()
    except ClaimedError as error:
        commander = error.commander
        pid = commander.pid if commander is not None and commander.here else None
        message = f"{arm.name}: {error}; {error.remedy}"
        raise _OwnedError(arm, message, pid) from error
    except OSError:
        return


def _runs(pid: int | None) -> bool:
    """Whether an owner runs; an unknown one may have just been killed."""
    if pid is None:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _program() -> str:
    """Name of this program."""
    called = Path(sys.argv[0])
    return called.parent.name if called.name == "__main__.py" else called.name


def _folder() -> Path:
    """Folder of the locks, the same for all users of this computer."""
    for folder in _FOLDERS:
        try:
            mode = folder.stat().st_mode
        except OSError:
            continue
        if mode & stat.S_ISVTX and mode & stat.S_IWOTH:
            return folder
    return _FOLDERS[-1]
