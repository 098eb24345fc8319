"""An emulated UR controller without its network: safety, programs, watchdog, dashboard, outputs."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum

import numpy as np

from drivers.emulators.ur_arm import HOME_RAD, Decelerate, Joints
from drivers.emulators.ur_script import ControlScript, Effects, Registers, ScriptError
from drivers.rtde_wire import OUTPUTS, REGISTERS, TYPES, Value
from drivers.ur_kinematics import UR5E, UrModel
from drivers.ur_pose import pose_of

#: Seconds of one controller cycle.
CYCLE_S = 0.002

_UPLOAD_S = 0.05  # from the upload of a program until it runs
_UNLOCK_AFTER_S = 5.0
_STOP_RAD_PER_S2 = 12.0  # when a program ends in motion
_PROTECTIVE_RAD_PER_S2 = 40.0


class Runtime(IntEnum):
    """State of the program, as RTDE reports it."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class Safety(StrEnum):
    """Safety mode, as the dashboard names it."""

    NORMAL = "NORMAL"
    PROTECTIVE_STOP = "PROTECTIVE_STOP"
    SAFEGUARD_STOP = "SAFEGUARD_STOP"
    ROBOT_EMERGENCY_STOP = "ROBOT_EMERGENCY_STOP"


_SAFETY_MODES = {
    Safety.NORMAL: 1,
    Safety.PROTECTIVE_STOP: 3,
    Safety.SAFEGUARD_STOP: 5,
    Safety.ROBOT_EMERGENCY_STOP: 7,
}
_STOPPED_FOR_SAFETY = 1 << 10
_SAFETY_BITS = {
    Safety.NORMAL: 1 << 0,
    Safety.PROTECTIVE_STOP: 1 << 2 | _STOPPED_FOR_SAFETY,
    Safety.SAFEGUARD_STOP: 1 << 4 | _STOPPED_FOR_SAFETY,
    Safety.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | _STOPPED_FOR_SAFETY,
}
_POWER_OFF, _IDLE, _RUNNING = 3, 5, 7
_ROBOT_MODES = {_POWER_OFF: "POWER_OFF", _IDLE: "IDLE", _RUNNING: "RUNNING"}


@dataclass(frozen=True)
class ControllerOptions:
    """Properties of the emulated controller.

    version     PolyScope version: major, minor, bugfix, build
    time_scale  controller seconds per real second
    start_rad   joints at which the arm stands at first
    """

    version: tuple[int, int, int, int] = (5, 12, 2, 1101534)
    model: UrModel = UR5E
    time_scale: float = 1.0
    serial_number: str = "20225500001"
    start_rad: tuple[float, ...] = HOME_RAD


@dataclass
class _Watchdog:
    register: int
    patience_s: float
    fed_s: float


@dataclass(frozen=True)
class ControllerEvent:
    """An event, at `t_s` of this computer's monotonic clock."""

    t_s: float
    what: str


class Controller:
    """State of a controller; `tick` it every 2 ms."""

    def __init__(self, options: ControllerOptions) -> None:
        self.options = options
        self.joints = Joints(options.model, np.array(options.start_rad))
        self.registers = Registers()
        self.time_s = 100.0
        self.runtime = Runtime.STOPPED
        self.safety = Safety.NORMAL
        self.robot_mode = _RUNNING
        self.remote_control = True
        self.speed_fraction = 1.0  # of the slider
        self.speed_scaling = 1.0  # of the controller's own limiter
        self.digital_inputs = 0  # bits: 0 to 7 standard, 8 to 15 configurable, 16 and 17 tool
        self.digital_outputs = 0  # the same; they keep their values when a client goes
        self.held_outputs = 0  # those that the installation assigns to something else
        self.events: deque[ControllerEvent] = deque(maxlen=1000)
        self.last_moved_s = 0.0  # monotonic time of the last motion of the arm
        self.servo_writes = 0
        self.dashboard_lines = 0
        self.servo_gaps_s: deque[float] = deque(maxlen=60_000)  # between two writes of a motion
        self._servo_s: float | None = None
        self._step_s = CYCLE_S * options.time_scale
        self.payload_kg = 0.0
        self._script: ControlScript | None = None
        self._uploaded: tuple[float, int] | None = None  # when it starts, register offset
        self._coasting: Decelerate | None = None
        self._watchdog: _Watchdog | None = None
        self._stopped_s = 0.0
        self._posed_at: tuple[object, object] = (None, None)  # joints and tool of `_posed`
        self._posed: list[float] = []

    def note(self, text: str) -> None:
        """Remember an event."""
        self.events.append(ControllerEvent(time.monotonic(), text))

    # --- time ---------------------------------------------------------------------------------

    def tick(self) -> None:
        """One controller cycle."""
        self.time_s += self._step_s
        if self._uploaded is not None and self.time_s >= self._uploaded[0]:
            self._start(self._uploaded[1])
        if self._script is not None and self.runtime is Runtime.PLAYING:
            self._run_script(self._script)
        elif self._coasting is not None:
            if not self._coasting.step(self.joints, self._step_s, 1.0):
                self._coasting = None
        else:
            self.joints.rest()
        if self.joints.fastest_rad_per_s > 1e-4:
            self.last_moved_s = time.monotonic()

    def miss(self, cycles: int) -> None:
        """Let time pass without doing anything: a controller's clock does not wait for it."""
        self.time_s += cycles * self._step_s
        self.note(f"{cycles} cycles missed: this computer is too busy")

    def _run_script(self, script: ControlScript) -> None:
        try:
            if not script.cycle(self._step_s, self.speed_fraction):
                self.end_program("stopped by command")
                return
        except ScriptError as error:
            self.end_program(f"runtime error: {error}")
            return
        fastest = self.joints.fastest_rad_per_s
        if fastest > self.options.model.max_joint_speed_rad_per_s * 1.05:
            self.protective_stop(f"a joint turns at {fastest:.2f} rad/s")
        watchdog = self._watchdog
        if watchdog is not None and self.time_s - watchdog.fed_s > watchdog.patience_s:
            self.end_program("watchdog: no command in time")

    # --- programs -----------------------------------------------------------------------------

    def upload(self, text: str) -> None:
        """Accept a program; only ur-rtde's own command loop can run."""
        if self.safety is not Safety.NORMAL or self.robot_mode != _RUNNING:
            self.note(f"upload refused: {self.safety}, {_ROBOT_MODES[self.robot_mode]}")
            return
        if not self.remote_control:
            self.note("upload refused: local control")
            return
        self.end_program("replaced by another program")
        if "RTDE Control script - Main loop" not in text:
            self.note("program refused: not the command loop of ur-rtde")
            return
        offset = re.search(r"global reg_offset_int = # int register offset\s+(\d+)", text)
        self._uploaded = (self.time_s + _UPLOAD_S, int(offset.group(1)) if offset else 0)

    def _start(self, offset: int) -> None:
        self._uploaded = None
        self._coasting = None
        effects = Effects(self.protective_stop, self._watch, self._set_payload, self.note)
        self._script = ControlScript(self.registers, self.joints, effects, offset)
        self.runtime = Runtime.PLAYING
        self.note("program started")

    def end_program(self, why: str) -> None:
        """End the program, if there is one; the arm comes to rest."""
        self._uploaded = None
        self._watchdog = None
        self._servo_s = None
        if self.runtime is not Runtime.STOPPED:
            self.note(f"program ended: {why}")
            self._coast(_STOP_RAD_PER_S2)
        self._script = None
        self.runtime = Runtime.STOPPED

    def _coast(self, deceleration: float) -> None:
        self._coasting = Decelerate(deceleration, in_joints=True)

    def _watch(self, register: int, frequency_hz: float) -> None:
        self._watchdog = _Watchdog(register, 1.0 / max(frequency_hz, 1e-3), self.time_s)

    def _set_payload(self, mass_kg: float) -> None:
        self.payload_kg = mass_kg

    # --- safety -------------------------------------------------------------------------------

    def protective_stop(self, why: str) -> None:
        """Stop hard; the program pauses until somebody unlocks and plays or uploads."""
        self._stop_for_safety(Safety.PROTECTIVE_STOP, why)
        if self.runtime is Runtime.PLAYING:
            self.runtime = Runtime.PAUSED

    def safeguard_stop(self) -> None:
        """A guard is open: the program pauses."""
        self._stop_for_safety(Safety.SAFEGUARD_STOP, "a guard is open")
        if self.runtime is Runtime.PLAYING:
            self.runtime = Runtime.PAUSED

    def emergency_stop(self) -> None:
        """The button is pressed: power goes off, the program ends."""
        self.end_program("emergency stop")
        self._stop_for_safety(Safety.ROBOT_EMERGENCY_STOP, "the button is pressed")
        self.robot_mode = _POWER_OFF

    def clear_safety(self) -> None:
        """Release, unlock and power on, as a person does at the pendant."""
        self.safety = Safety.NORMAL
        self.robot_mode = _RUNNING
        self.note("safety cleared")

    def power_off(self) -> None:
        """The controller loses power: arm braked, program, registers and outputs gone."""
        self.end_program("power off")
        self.joints.rest()
        self._coasting = None
        self.registers = Registers()
        self.digital_outputs = 0
        self.note("power off")

    def put_home(self) -> None:
        """Put the arm back where it was at the start, as a person would by hand; no program."""
        self.end_program("put home")
        self._coasting = None
        self.joints = Joints(self.options.model, np.array(self.options.start_rad))

    def _stop_for_safety(self, safety: Safety, why: str) -> None:
        self.safety = safety
        self._stopped_s = self.time_s
        self._coast(_PROTECTIVE_RAD_PER_S2)
        self.note(f"{safety}: {why}")

    # --- RTDE ---------------------------------------------------------------------------------

    def write(self, values: Mapping[str, Value]) -> None:
        """Input variables of one packet."""
        for name, value in values.items():
            if (index := _INT_INPUTS.get(name)) is not None and isinstance(value, int):
                self.registers.int_in[index] = value
                self._note_command(index, value)
            elif (index := _DOUBLE_INPUTS.get(name)) is not None and isinstance(value, float):
                self.registers.double_in[index] = value
        fraction = values.get("speed_slider_fraction")
        if values.get("speed_slider_mask") and isinstance(fraction, float):
            self.speed_fraction = min(1.0, max(0.0, fraction))
        for group, (shift, there) in _OUTPUT_GROUPS.items():
            mask, bits = values.get(f"{group}_mask"), values.get(group)
            if isinstance(mask, int) and isinstance(bits, int):
                mask = (mask & there & ~(self.held_outputs >> shift)) << shift
                self.digital_outputs = self.digital_outputs & ~mask | bits << shift & mask

    def set_inputs(self, bits: int, mask: int = 0x3FFFF) -> None:
        """Voltage at digital inputs: 0 to 7 standard, 8 to 15 configurable, 16 and 17 tool.

        mask  of those that are set; the others stay
        """
        self.digital_inputs = self.digital_inputs & ~mask | bits & mask

    def _note_command(self, register: int, value: int) -> None:
        if self._watchdog is not None and self._watchdog.register == register:
            self._watchdog.fed_s = self.time_s
        if value in (11, 24):
            now_s = time.monotonic()
            if self._servo_s is not None:
                self.servo_gaps_s.append(now_s - self._servo_s)
            self._servo_s = now_s
            self.servo_writes += 1
        elif register in (0, 24):
            self._servo_s = None

    def outputs(self, names: Sequence[str]) -> list[Value]:
        """Values of output variables now."""
        return self.reader(names)()

    def reader(self, names: Sequence[str]) -> Callable[[], list[Value]]:
        """Function that returns the values of output variables, for 500 calls a second."""
        getters = [_getter(name) for name in names]
        return lambda: [get(self) for get in getters]

    def pose(self) -> list[float]:
        """The tool's pose, computed again only after a motion."""
        at = self.joints.q_rad, self.joints.X_FT
        if at[0] is not self._posed_at[0] or at[1] is not self._posed_at[1]:
            self._posed_at, self._posed = at, pose_of(self.joints.tool()).tolist()
        return self._posed

    # --- dashboard ----------------------------------------------------------------------------

    def dashboard(self, line: str) -> str:
        """Answer to a dashboard command; ur-rtde compares some of them letter by letter."""
        self.dashboard_lines += 1
        command = line.strip().lower()
        playing = self.runtime is Runtime.PLAYING
        match command:
            case "polyscopeversion":
                return "URSoftware {}.{}.{}.{} (Jul 06 2022)".format(*self.options.version)
            case "get serial number":
                return self.options.serial_number
            case "get robot model":
                return self.options.model.name.removesuffix("e")
            case "is in remote control":
                return str(self.remote_control).lower()
            case "running":
                return f"Program running: {str(playing).lower()}"
            case "programstate":
                return f"{self.runtime.name} rtde_control"
            case "robotmode":
                return f"Robotmode: {_ROBOT_MODES[self.robot_mode]}"
            case "safetymode" | "safetystatus":
                return f"S{command[1:]}: {self.safety}"
            case "stop":
                self.end_program("stopped at the dashboard")
                return "Stopped"
            case "play":
                if self.runtime is Runtime.PAUSED and self.safety is Safety.NORMAL:
                    self.runtime = Runtime.PLAYING
                    return "Starting program"
                return "Failed to execute: play"
            case "pause":
                if playing:
                    self.runtime = Runtime.PAUSED
                    return "Pausing program"
                return "Failed to execute: pause"
            case "unlock protective stop":
                return self._unlock()
            case "close safety popup":
                return "closing safety popup"
            case "power on":
                self.robot_mode = _IDLE
                return "Powering on"
            case "power off":
                self.end_program("power off")
                self.robot_mode = _POWER_OFF
                return "Powering off"
            case "brake release":
                self.robot_mode = _RUNNING
                return "Brake releasing"
            case _:
                return f"could not understand: '{line.strip()}'"

    def _unlock(self) -> str:
        if self.safety is Safety.PROTECTIVE_STOP:
            if self.time_s - self._stopped_s < _UNLOCK_AFTER_S:
                return (
                    "Cannot unlock protective stop until 5s after occurrence. Always inspect "
                    "cause of protective stop before unlocking"
                )
            self.safety = Safety.NORMAL
            self.note("unlocked")
        return "Protective stop releasing"


# --- RTDE: variables by their names -------------------------------------------------------------

_INT_INPUTS = {f"input_int_register_{i}": i for i in range(REGISTERS)}
_DOUBLE_INPUTS = {f"input_double_register_{i}": i for i in range(REGISTERS)}

_OUTPUT_GROUPS = {
    "standard_digital_output": (0, 0xFF),
    "configurable_digital_output": (8, 0xFF),
    "tool_digital_output": (16, 0b11),
}

_REGISTER = re.compile(r"(in|out)put_(int|double)_register_(\d+)")

_Getter = Callable[[Controller], Value]


def _powered(controller: Controller) -> int:
    playing = controller.runtime is Runtime.PLAYING
    return int(controller.robot_mode != _POWER_OFF) | playing << 1


_GETTERS: Mapping[str, _Getter] = {
    "timestamp": lambda c: c.time_s,
    "actual_TCP_pose": Controller.pose,
    "target_TCP_pose": Controller.pose,
    "actual_TCP_speed": lambda c: c.joints.tool_speed().tolist(),
    "target_TCP_speed": lambda c: c.joints.tool_speed().tolist(),
    "actual_q": lambda c: c.joints.q_rad.tolist(),
    "target_q": lambda c: c.joints.q_rad.tolist(),
    "actual_qd": lambda c: c.joints.qd_rad_per_s.tolist(),
    "target_qd": lambda c: c.joints.qd_rad_per_s.tolist(),
    "runtime_state": lambda c: int(c.runtime),
    "robot_status_bits": _powered,
    "safety_status_bits": lambda c: _SAFETY_BITS[c.safety],
    "safety_mode": lambda c: _SAFETY_MODES[c.safety],
    "safety_status": lambda c: _SAFETY_MODES[c.safety],
    "robot_mode": lambda c: c.robot_mode,
    "target_speed_fraction": lambda c: c.speed_fraction,
    "speed_scaling": lambda c: c.speed_scaling,
    "payload": lambda c: c.payload_kg,
    "actual_digital_input_bits": lambda c: c.digital_inputs,
    "actual_digital_output_bits": lambda c: c.digital_outputs,
    "joint_mode": lambda c: [253] * 6,
}


def _getter(name: str) -> _Getter:
    """Function that returns an output variable; 0 for those that are not emulated."""
    if (register := _REGISTER.fullmatch(name)) is not None:
        attribute = f"{register[2]}_{register[1]}"
        index = int(register[3])
        return lambda c: getattr(c.registers, attribute)[index]
    count = TYPES[OUTPUTS[name]][1]
    nothing: Value = 0 if count == 1 else [0] * count
    return _GETTERS.get(name, lambda c: nothing)
