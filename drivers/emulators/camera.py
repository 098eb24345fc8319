"""Emulated camera: a process that streams rendered pictures to its clients, on loopback.

OpenCV opens its address as it is: pictures arrive unchanged, bit by bit, with their time stamps.
"""

from __future__ import annotations

import os
import queue
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from typing import Protocol

import cv2
import numpy as np

from drivers.clock import sleep_until
from drivers.emulators.camera_poses import PRIORITY
from drivers.emulators.camera_stream import picture_header, stream_header
from drivers.emulators.launch import EmulatorProcess, leave_interrupts_to_parent, serve_requests
from drivers.interfaces import Image
from drivers.priority import run_in_real_time
from drivers.threads import GuardedThread, end_process, only_logged


class Scene(Protocol):
    """Interface of the scene of an emulated camera, used by one thread of its process."""

    def picture(self, t_s: float) -> Image:
        """(H, W) picture with the middle of its exposure at `t_s` of the monotonic clock, a few
        milliseconds ago.
        """
        ...

    def keep_up(self) -> None:
        """Called many times a second, whether or not anybody looks."""
        ...

    def notify(self, message: object) -> None:
        """Message of the parent process, e.g. that a cable was gripped."""
        ...


#: Makes a scene in the camera's process: a picklable callable.
SceneFactory = Callable[[], Scene]


@dataclass(frozen=True)
class TestCard:
    """Empty scene: its grey level rises by one per period, and so encodes the frame number."""

    __test__ = False  # not a test, whatever its name

    width_px: int
    height_px: int
    rate_hz: float

    def __call__(self) -> TestCard:
        """Its own factory."""
        return self

    def picture(self, t_s: float) -> Image:
        """Grey level = column + row + number of the period."""
        columns = np.arange(self.width_px, dtype=np.int64)[None, :]
        rows = np.arange(self.height_px, dtype=np.int64)[:, None]
        shift = round(t_s * self.rate_hz) % 256
        image: Image = ((columns + shift).astype(np.uint8) + rows.astype(np.uint8)).astype(np.uint8)
        return image

    def keep_up(self) -> None:
        """Nothing happens to a test card."""

    def notify(self, message: object) -> None:
        """Messages to a test card have no effect."""


_POLL_S = 0.02  # polling interval of all waits


@dataclass(frozen=True)
class CameraEmulatorOptions:
    """Properties of the emulated camera.

    poll_s     from the middle of an exposure until the picture is requested from the scene: it
               may need measurements of other processes of that moment
    readout_s  from the middle of an exposure until the picture leaves the camera
    backlog_s  a picture that would leave that much too late is dropped, as in a real camera
    """

    width_px: int = 1280
    height_px: int = 1024
    frame_rate_hz: float = 200.0
    poll_s: float = 0.006
    readout_s: float = 0.012
    backlog_s: float = 0.25


@dataclass(frozen=True)
class StreamFaults:
    """Faults of the emulated camera, active until `faults` is set again.

    refuses  nobody may connect, and whoever is connected is cut off
    silent   no pictures leave, the connection stays
    frozen   the picture before is sent again and again, with new stamps
    missing  so many pictures are dropped, once
    slow     periods last that much longer
    garbage  random bytes in place of pictures
    """

    refuses: bool = False
    silent: bool = False
    frozen: bool = False
    missing: int = 0
    slow: float = 1.0
    garbage: bool = False


@dataclass(frozen=True)
class StreamCounts:
    """Pictures sent, dropped because the scene or the reader was too slow, and the latest of
    those sent, s after its time.
    """

    sent: int = 0
    dropped: int = 0
    latest_s: float = 0.0


class EmulatedCamera(EmulatorProcess):
    """A camera in its own process, alive within a `with`; it ends when its parent does.

    scene    picklable; called in the camera's process
    address  where it listens; port 0 = any that is free
    """

    def __init__(
        self,
        scene: SceneFactory,
        options: CameraEmulatorOptions | None = None,
        address: tuple[str, int] = ("127.0.0.1", 0),
    ) -> None:
        options = options if options is not None else CameraEmulatorOptions()
        super().__init__("camera", serve, (scene, options, address))
        self._faults = StreamFaults()
        self._host, self._port = address

    def started(self, port: int) -> None:
        """Take the port on which it listens."""
        self._port = port

    @property
    def url(self) -> str:
        """URL that OpenCV opens."""
        return f"tcp://{self._host}:{self._port}"

    @property
    def faults(self) -> StreamFaults:
        """Active faults."""
        return self._faults

    @faults.setter
    def faults(self, faults: StreamFaults) -> None:
        self._faults = faults
        self.request("faults", faults)

    def notify(self, message: object) -> None:
        """Tell the scene something picklable.  Raises EmulatorError: it does not understand."""
        self.request("tell", message)

    def counts(self) -> StreamCounts:
        """Counts of the pictures sent and dropped."""
        counts: StreamCounts = self.request("counts")
        return counts


# --- the camera's process ---------------------------------------------------------------------


def serve(
    door: Connection,
    factory: SceneFactory,
    options: CameraEmulatorOptions,
    address: tuple[str, int],
) -> None:
    """Main loop of the emulated camera's process: stream until the connection `door` is closed."""
    leave_interrupts_to_parent()
    cv2.setNumThreads(1)  # OpenCV's own threads would have to wait for the rest of the computer
    try:
        scene = factory()
        _check(scene.picture(time.monotonic() - options.poll_s), options)
        server = _Server(scene, options, address)
    except Exception as error:
        door.send((False, f"{type(error).__name__}: {error}"))
        return
    # a camera does not slow down when the computer is busy; the arm's emulator goes before it
    run_in_real_time(PRIORITY)
    GuardedThread("door", partial(serve_requests, door, server.serve_request), end_process).start()
    door.send((True, server.port))
    server.run()


def _check(image: Image, options: CameraEmulatorOptions) -> None:
    wanted = (options.height_px, options.width_px)
    if image.shape != wanted or image.dtype != "uint8":
        raise ValueError(f"the scene's picture is {image.shape} {image.dtype}, not {wanted} uint8")


@dataclass(frozen=True)
class _Parcel:
    """Bytes to send, not before `leave_s`."""

    leave_s: float
    parts: tuple[bytes | memoryview, ...]


#: Something for the scene, and where to put the error that it raises.
_Message = tuple[object, "queue.SimpleQueue[Exception | None]"]


class _Server:
    """One client at a time; looks in one thread, sends in another."""

    def __init__(
        self, scene: Scene, options: CameraEmulatorOptions, address: tuple[str, int]
    ) -> None:
        self.faults = StreamFaults()
        self._counts = StreamCounts()
        self._messages: queue.SimpleQueue[_Message] = queue.SimpleQueue()
        self._scene = scene
        self._options = options
        self._listener: socket.socket | None = socket.create_server(address)
        self._host, self.port = self._listener.getsockname()

    def serve_request(self, name: str, content: object) -> object:
        """Serve a request of the parent.  Raises any error of the scene on a message."""
        if name == "faults" and isinstance(content, StreamFaults):
            self.faults = content
            self._wait_for_door()
        elif name == "tell":
            answer: queue.SimpleQueue[Exception | None] = queue.SimpleQueue()
            self._messages.put((content, answer))
            error = answer.get()
            if error is not None:
                raise error
        elif name == "counts":
            return self._counts
        return None

    def _wait_for_door(self) -> None:
        """Wait until it is shut or open as the faults want it."""
        until_s = time.monotonic() + 1.0
        while (self._listener is None) != self.faults.refuses and time.monotonic() < until_s:
            time.sleep(1e-3)

    def run(self) -> None:
        """Serve clients for ever."""
        while True:
            client = self._accept()
            with client:
                parcels: queue.Queue[_Parcel | None] = queue.Queue()
                gone = threading.Event()
                sender = GuardedThread(
                    "sender", partial(self._send_all, client, parcels, gone), only_logged
                )
                sender.start()
                try:
                    self._poll(parcels, gone)
                finally:
                    gone.set()
                    parcels.put(None)
                    sender.join()

    def _accept(self) -> socket.socket:
        while True:
            if self.faults.refuses:
                if self._listener is not None:
                    self._listener.close()
                    self._listener = None
                time.sleep(_POLL_S)
                self._deliver_messages()
                continue
            if self._listener is None:
                self._listener = socket.create_server((self._host, self.port))
            self._listener.settimeout(_POLL_S)
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                self._deliver_messages()
                continue
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.settimeout(_POLL_S)
            return client

    def _poll(self, parcels: queue.Queue[_Parcel | None], gone: threading.Event) -> None:
        """Take pictures at their times until the client has gone."""
        options = self._options
        size = (options.width_px, options.height_px)
        start_s = due_s = time.monotonic()
        header = stream_header(*size, options.frame_rate_hz)
        parcels.put(_Parcel(start_s, (header,)))
        image: Image | None = None
        missing_of: StreamFaults | None = None
        missing = 0
        while not gone.is_set():
            faults = self.faults
            due_s += faults.slow / options.frame_rate_hz
            sleep_until(due_s + options.poll_s)
            self._deliver_messages()
            if self._somebody_waits():
                break  # the former reader has ended without closing
            if faults is not missing_of:
                missing_of, missing = faults, faults.missing
            behind = parcels.qsize() / options.frame_rate_hz > options.backlog_s
            if behind or time.monotonic() > due_s + options.readout_s + options.backlog_s:
                self._counts = replace(self._counts, dropped=self._counts.dropped + 1)
                continue
            if missing > 0:
                missing -= 1
                continue
            if faults.silent:
                continue
            if image is None or not faults.frozen:
                image = self._scene.picture(due_s)
            parts: tuple[bytes | memoryview, ...]
            if faults.garbage:
                parts = (os.urandom(image.size),)
            else:
                parts = (picture_header(due_s - start_s, image.size), image.data.cast("B"))
            parcels.put(_Parcel(due_s + options.readout_s, parts))

    def _somebody_waits(self) -> bool:
        listener = self._listener
        return listener is not None and bool(select.select([listener], [], [], 0.0)[0])

    def _send_all(
        self,
        client: socket.socket,
        parcels: queue.Queue[_Parcel | None],
        gone: threading.Event,
    ) -> None:
        try:
            while (parcel := self._next(client, parcels)) is not None:
                sleep_until(parcel.leave_s)
                late_s = time.monotonic() - parcel.leave_s
                for part in parcel.parts:
                    self._send(client, memoryview(part), gone)
                latest_s = max(self._counts.latest_s, late_s)
                self._counts = replace(self._counts, sent=self._counts.sent + 1, latest_s=latest_s)
        except OSError:
            return  # the reader has gone
        finally:
            gone.set()

    def _next(self, client: socket.socket, parcels: queue.Queue[_Parcel | None]) -> _Parcel | None:
        """The next parcel; meanwhile see whether the reader is still there.  Raises OSError."""
        while True:
            try:
                return parcels.get(timeout=_POLL_S)
            except queue.Empty:
                self._check_not_refused()
            if select.select([client], [], [], 0.0)[0]:  # a reader sends nothing: this is its end
                raise ConnectionResetError("the reader has gone")

    def _check_not_refused(self) -> None:
        if self.faults.refuses:
            raise ConnectionAbortedError("cut off")

    def _send(self, client: socket.socket, data: memoryview, gone: threading.Event) -> None:
        """Send all of it, however slow the reader.  Raises OSError: it has gone, or must go."""
        while data:
            self._check_not_refused()
            if gone.is_set():
                raise ConnectionAbortedError("somebody else reads now")
            try:
                data = data[client.send(data) :]
            except TimeoutError:
                continue

    def _deliver_messages(self) -> None:
        """Deliver the waiting messages to the scene, and let it keep up."""
        self._scene.keep_up()
        while True:
            try:
                message, answer = self._messages.get_nowait()
            except queue.Empty:
                return
            try:
                self._scene.notify(message)
                answer.put(None)
            except Exception as error:
                answer.put(error)
