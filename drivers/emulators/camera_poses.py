"""Reads an emulated arm's true poses over a connection of its own, independent of the driver.

The pictures must not depend on what the driver under test believes, so this is a connection of
its own: the joints of the controller, and the kinematics.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import deque

import numpy as np

from drivers.interfaces import FloatArray, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.priority import run_in_real_time
from drivers.rtde_wire import RTDE_PORT, PackageType, Packet, Splitter
from drivers.threads import GuardedThread, end_process
from drivers.ur_kinematics import UrModel

#: Of everything in the camera's process: behind the arm, before ordinary programs.
PRIORITY = 10

#: Between two looks for poses, s: no multiple of the controller's cycle, so that now and then one
#: comes while it is awaited, which compares the clocks; and less than a picture can wait for one.
_REST_S = 0.0043
_HZ = 500.0  # at 125 the cable would swing through 48 ms anew for each picture, not 12
_RETRY_S = 0.2
_SENSELESS_S = 0.5  # bytes that are no poses for so long: listen anew
_WINDOW = 250  # looks over which the controller's clock is compared with this computer's: a second
_NAMES = "timestamp,actual_q"
_PAYLOAD = np.dtype([("recipe", "u1"), ("t_s", ">f8"), ("q_rad", ">f8", 6)])


class RtdePoses:
    """Poses of an emulated arm's gripping point, from a thread that listens.

    X_FT  (4, 4) tool on the flange: its origin is the gripping point
    """

    def __init__(self, host: str, mount: PlaneMount, model: UrModel, X_FT: FloatArray) -> None:
        self._address = (host, RTDE_PORT)
        self._mount = mount
        self._model = model
        self._X_FT = X_FT
        self._lock = threading.Lock()
        self._new: list[bytes] = []  # payloads of packets
        self._offset_s = 0.0
        self._last_s = -np.inf
        GuardedThread("poses", self._listen, end_process).start()

    def __call__(self) -> Trajectory | None:
        """Poses since the last call, times on the monotonic clock; None = there are none."""
        with self._lock:
            new, self._new = self._new, []
            offset_s = self._offset_s
        rows = np.frombuffer(b"".join(new), dtype=_PAYLOAD)
        t_s = rows["t_s"] + offset_s
        later = t_s > self._last_s  # the two clocks may have been compared anew
        if not later.any():
            return None
        t_s, X_BT = t_s[later], self._model.forward_each(rows["q_rad"][later], self._X_FT)
        self._last_s = float(t_s[-1])
        return Trajectory(t_s, *self._mount.each_to_plane(X_BT).T)

    def _listen(self) -> None:
        """Listen for ever; an arm without power stays where it was."""
        run_in_real_time(PRIORITY)  # whoever hears late shows the arm where it was
        while True:
            try:
                with socket.create_connection(self._address, 1.0) as controller:
                    controller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self._receive(controller)
            except (OSError, ValueError):
                time.sleep(_RETRY_S)

    def _receive(self, controller: socket.socket) -> None:
        request = struct.pack(">d", _HZ) + _NAMES.encode()
        controller.sendall(
            Packet(PackageType.PROTOCOL_VERSION, b"\x00\x02").encoded()
            + Packet(PackageType.OUTPUT_SETUP, request).encoded()
            + Packet(PackageType.START).encoded()
        )
        splitter = Splitter()
        offsets_s: deque[float] = deque(maxlen=_WINDOW)
        heard_s = time.monotonic()
        while data := controller.recv(65536):
            arrived_s = time.monotonic()
            if arrived_s > heard_s + _SENSELESS_S:
                raise OSError("only nonsense comes")
            payloads = [p.payload for p in splitter.feed(data) if p.kind == PackageType.DATA]
            if payloads:
                if any(len(payload) != _PAYLOAD.itemsize for payload in payloads):
                    raise ValueError("not what was asked for")
                heard_s = arrived_s
                (last,) = np.frombuffer(payloads[-1], dtype=_PAYLOAD)
                offsets_s.append(arrived_s - float(last["t_s"]))
                with self._lock:
                    self._offset_s = min(offsets_s)
                    self._new += payloads
            time.sleep(_REST_S)
