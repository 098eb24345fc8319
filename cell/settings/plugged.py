"""Devices of other packages: `kind: NAME` of arm, camera or gripper, found by its entry point.

A package registers `SECTION.KIND`, such as `camera.acme`, in the group `cable_cell.devices`.  The
entry point is a class with the interface of its section in `drivers.interfaces`, and with

    settings_class                            a subclass of `PluggedArm`, `…Camera` or `…Gripper`
    from_settings(settings, clock, delay_s)   the device, not connected; delay_s as calibrated: the
                                              lag of an arm, the latency of a camera, s
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any, TypeVar, get_args

from pydantic import Field, create_model

from cell.files.input_error import InputError, did_you_mean
from cell.files.words import error_text
from cell.files.yaml_document import Document, validate
from cell.settings import devices
from cell.settings.model import Settings
from cell.settings.section import Section
from drivers.interfaces import Arm, Camera, Clock, DeviceError, DeviceLostError, Gripper

T = TypeVar("T")
GROUP = "cable_cell.devices"


class PluggedDevice(Section):
    """Settings of a device of another package."""

    kind: str
    """Name of its entry point."""

    @property
    def place(self) -> str:
        """Address, port or serial number: two programs must not use it at the same time."""
        return ""


class PluggedArm(PluggedDevice):
    """Settings that every arm has."""

    rate_hz: Annotated[float, Field(ge=50.0, le=1000.0)] = 500.0
    """Poses sent and measured per second."""
    lag_s: Annotated[float, Field(ge=0.0, le=0.3)] = 0.0
    """How late it follows; measured."""


class PluggedCamera(PluggedDevice, devices.RealCameraSettings):
    """Settings that every camera has."""


class PluggedGripper(PluggedDevice, devices.GripperSettings):
    """Settings that every gripper has."""


_BASES: Mapping[str, type[PluggedDevice]] = {
    "arm": PluggedArm,
    "camera": PluggedCamera,
    "gripper": PluggedGripper,
}
_INTERFACES: Mapping[str, type] = {"arm": Arm, "camera": Camera, "gripper": Gripper}


def validated(document: Document) -> Settings:
    """The document as settings, with devices of other packages.

    raises  InputError: an unknown kind, a package that does not load, and every other mistake
    """
    wanted: dict[str, type[PluggedDevice]] = {}
    wrong: dict[str, str] = {}
    for section, kind in _foreign_kinds(document.data).items():
        try:
            wanted[section] = driver_class(section, kind).settings_class
        except ValueError as error:
            wrong[f"{section}.kind"] = str(error)
    try:
        return validate(document, _with(wanted))
    except InputError as error:
        problems = [replace(p, message=wrong.get(p.key, p.message)) for p in error.problems]
        raise InputError(problems) from error


def settings_class(data: Mapping[str, Any]) -> type[Settings]:
    """Settings class that accepts the kinds of devices in `data`.  Raises ValueError."""
    kinds = _foreign_kinds(data).items()
    return _with({section: driver_class(section, kind).settings_class for section, kind in kinds})


def driver_class(section: str, kind: str) -> Any:
    """The class that an entry point names.  Raises ValueError: there is none, or no such class."""
    registered = {e.name: e for e in entry_points(group=GROUP)}
    entry = registered.get(f"{section}.{kind}")
    if entry is None:
        others = [n.partition(".")[2] for n in registered if n.startswith(f"{section}.")]
        known = [*_kinds(section), *sorted(others)]
        raise ValueError(
            f"{kind!r} is not one of {', '.join(map(repr, known))}{did_you_mean(kind, known)}; "
            f"or install the package that has this {section} (`cell help extend`)"
        )
    return _load(section, entry)


def _load(section: str, entry: EntryPoint) -> Any:
    package = entry.dist.name if entry.dist is not None else entry.value
    try:
        driver = entry.load()
    except Exception as error:
        raise ValueError(
            f"the package {package} does not load: {error_text(error)}; mend or remove it"
        ) from error
    base = _BASES[section]
    wrong = f"{entry.value} of the package {package}"
    settings = getattr(driver, "settings_class", None)
    if not (isinstance(settings, type) and issubclass(settings, base)):
        raise ValueError(f"{wrong} needs a `settings_class` derived from {base.__name__}")
    wanted = (*_methods(section), "from_settings")
    lacking = [n for n in wanted if not callable(getattr(driver, n, None))]
    if lacking:
        raise ValueError(f"{wrong} lacks {', '.join(lacking)} of a {section}; add it")
    return driver


def place_of(settings: Section) -> str | None:
    """Name of the resource that only one program may use; None = it is the project's own device."""
    return (
        f"{settings.kind} {settings.place}".rstrip()
        if isinstance(settings, PluggedDevice)
        else None
    )


def plugged_in(section: str, settings: Section, clock: Clock, delay_s: float = 0.0) -> Any:
    """Device from another package, not connected; None = the device is the project's own.

    Its methods raise DeviceLostError in place of an error that is no DeviceError: the cell stops
    then as after any fault of a device.
    """
    if not isinstance(settings, PluggedDevice):
        return None
    device = driver_class(section, settings.kind).from_settings(settings, clock, delay_s)
    for name in _methods(section):
        setattr(device, name, _as_fault(device.name, getattr(device, name)))
    return device


def _as_fault(device: str, method: Callable[..., T]) -> Callable[..., T]:
    """A driver's method whose own errors are a fault of its device."""

    @wraps(method)
    def call(*values: Any, **options: Any) -> T:
        try:
            return method(*values, **options)
        except DeviceError:
            raise
        except Exception as error:  # each driver has errors of its own
            cause = f"its driver failed in `{method.__name__}`: {error_text(error)}"
            remedy = "check the device's cable and power, or correct the driver, then reset"
            raise DeviceLostError(device, cause, remedy) from error

    return call


def _methods(section: str) -> list[str]:
    """Names of the methods of a section's interface, without its properties."""
    members = vars(_INTERFACES[section]).items()
    return [name for name, v in members if callable(v) and not name.startswith("_")]


def _foreign_kinds(data: Any) -> dict[str, str]:
    """Kinds of the sections that are not the project's own."""
    kinds = {}
    for section in _BASES:
        part = data.get(section) if isinstance(data, Mapping) else None
        kind = part.get("kind") if isinstance(part, Mapping) else None
        if isinstance(kind, str) and kind not in _kinds(section):
            kinds[section] = kind
    return kinds


def _kinds(section: str) -> list[str]:
    """The project's own kinds of a section."""
    members = get_args(Settings.model_fields[section].annotation)
    return [get_args(m.model_fields["kind"].annotation)[0] for m in members]


def _with(wanted: Mapping[str, type[PluggedDevice]]) -> type[Settings]:
    if not wanted:
        return Settings
    fields: dict[str, Any] = {section: (kind, ...) for section, kind in wanted.items()}
    return create_model("Settings", __base__=Settings, **fields)
