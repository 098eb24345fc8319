"""Where an emulated arm really is: a silent listener on its controller, as light would be.

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

from drivers.emulators.rtde_wire import Kind, Packet, Recipe, Splitter
from drivers.emulators.ur_addresses import RTDE_PORT
from drivers.interfaces import FloatArray, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.priority import run_in_real_time
from drivers.ur_kinematics import UrModel

#: Of everything in the camera's process: behind the arm, before ordinary programs.
PRIORITY = 10

_HZ = 500.0  # at 125 the cable would swing through 48 ms anew for each picture, not 12
_RETRY_S = 0.2
_SENSELESS_S = 0.5  # bytes that are no poses for so long: listen anew
_WINDOW = 500  # packets over which the controller's clock is compared with this computer's


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
        self._new: list[tuple[float, tuple[float, ...]]] = []  # controller's time, joints
        self._offset_s = 0.0
        self._last_s = -np.inf
        threading.Thread(target=self._listen, name="poses", daemon=True).start()

    def __call__(self) -> Trajectory | None:
        """Poses since the last call, times on the monotonic clock; None = there are none."""
        with self._lock:
            new, self._new = self._new, []
            offset_s = self._offset_s
        rows = []
        for t_s, q_rad in new:
            if t_s + offset_s <= self._last_s:
                continue  # the two clocks were compared anew
            self._last_s = t_s + offset_s
            pose = self._mount.to_plane(self._model.forward(np.array(q_rad), self._X_FT))
            rows.append((self._last_s, pose.x_m, pose.y_m, pose.angle_rad))
        return Trajectory(*np.array(rows).T) if rows else None

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
        names = ("timestamp", "actual_q")
        request = struct.pack(">d", _HZ) + ",".join(names).encode()
        controller.sendall(
            Packet(Kind.PROTOCOL_VERSION, b"\x00\x02").encoded()
            + Packet(Kind.OUTPUT_SETUP, request).encoded()
            + Packet(Kind.START).encoded()
        )
        recipe = Recipe(1, names, ("DOUBLE", "VECTOR6D"))
        splitter = Splitter()
        offsets_s: deque[float] = deque(maxlen=_WINDOW)
        heard_s = time.monotonic()
        while data := controller.recv(65536):
            arrived_s = time.monotonic()
            if arrived_s > heard_s + _SENSELESS_S:
                raise OSError("only nonsense comes")
            for packet in splitter.feed(data):
                if packet.kind != Kind.DATA:
                    continue
                values = recipe.decoded(packet.payload)
                t_s, q_rad = values["timestamp"], values["actual_q"]
                if not isinstance(t_s, float) or isinstance(q_rad, int | float):
                    raise ValueError("not what was asked for")
                heard_s = arrived_s
                offsets_s.append(arrived_s - t_s)
                with self._lock:
                    self._offset_s = min(offsets_s)
                    self._new.append((t_s, tuple(q_rad)))
