"""What nobody has read reaches no file, socket or process: escapes tried inside the sandbox.

The check by names is left out here: what is proven is the sandbox itself.
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.confined import main
from cell.cable.effects import CableData, Effect, EffectError, HandMotion, load_effect, remote
from cell.cable.effects.remote import MARK, confine_effects, is_remote
from cell.computer import confinement
from cell.computer.sandbox import Nursery, decode, encode

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is no sandbox elsewhere")

CABLE = CableData(0.016, 1e-4, 0.0074, 0.1)

#: What is tried, as one expression each; it escapes if it returns anything.  `HERE` is a folder
#: that everybody may write to, `SECRET` a file that all may read, `LINE` a socket that listens.
ESCAPES = {
    "read a file": "open(SECRET).read()",
    "read by the system": "os.read(os.open(SECRET, os.O_RDONLY), 9)",
    "read a folder": "os.listdir(HERE)",
    "write a file": "open(HERE + '/w', 'w')",
    "append to the own library": "open(np.__file__, 'a')",
    "cut the own library": "os.open(np.__file__, os.O_RDONLY | os.O_TRUNC)",
    "truncate": "os.truncate(SECRET, 0) or 1",
    "unlink": "os.unlink(SECRET) or 1",
    "rename": "os.rename(SECRET, HERE + '/r') or 1",
    "symlink": "os.symlink('/etc/passwd', HERE + '/s') or 1",
    "link": "os.link(SECRET, HERE + '/l') or 1",
    "follow a symlink": "open(HERE + '/to_secret').read()",
    "folder": "os.mkdir(HERE + '/m') or 1",
    "mode": "os.chmod(SECRET, 0o777) or 1",
    "pipe in a folder": "os.mkfifo(HERE + '/f') or 1",
    "file in memory": "os.memfd_create('x')",
    "numpy reads": "np.fromfile(SECRET, np.uint8).size",
    "numpy writes": "np.ones(3).tofile(HERE + '/n') or 1",
    "numpy maps": "np.memmap(HERE + '/n', mode='w+', shape=9)",
    "aliases of numpy": "touched(np.lib._npyio_impl.os.system('touch ' + HERE + '/a'))",
    "license": "printed(license)",
    "system": "touched(os.system('touch ' + HERE + '/a'))",
    "subprocess": "subprocess.run(['true'])",
    "spawn": "os.posix_spawn('/bin/true', ['true'], {})",
    "fork": "os.fork()",
    "exec": "os.execv('/bin/true', ['true'])",
    "thread": "_thread.start_new_thread(print, ())",
    "system of C": "touched(libc.system(b'touch ' + HERE.encode() + b'/a'))",
    "symbols of LLVM": "touched(ctypes.CFUNCTYPE(int, ctypes.c_char_p)"
    "(llvm.address_of_symbol('system'))(b'touch ' + HERE.encode() + b'/a'))",
    "fork of C": "libc.fork() >= 0",
    "internet": "socket.create_connection(('127.0.0.1', PORT), 1)",
    "socket of a file": "socket.socket(socket.AF_UNIX).connect(LINE) or 1",
    "listen": "socket.create_server(('127.0.0.1', 0))",
    "pair": "socket.socketpair()",
    "packets": "socket.socket(socket.AF_PACKET, socket.SOCK_RAW)",
    "names of computers": "socket.getaddrinfo('example.org', 80)",
    "signal to the parent": "os.kill(os.getppid(), 0) or 1",
    "signal to all": "os.kill(-1, 0) or 1",
    "signal by the system": "libc.syscall(62, PID, 0) == 0",
    "signal of a file": "fcntl.fcntl(LINE_NUMBER, fcntl.F_SETOWN, PID) or 1",
    "memory of others": "open(f'/proc/{PID}/mem', 'rb+')",
    "memory of its own": "open('/proc/self/mem', 'rb+')",
    "environment of others": "open(f'/proc/{PID}/environ').read()",
    "files of others": "os.listdir(f'/proc/{PID}/fd')",
    "trace": "libc.ptrace(16, PID, 0, 0) == 0",
    "read another's memory": "libc.syscall(310, PID, 0, 0, 0, 0, 0) == 0",
    "ring of requests": "libc.syscall(425, 8, (ctypes.c_char * 120)()) >= 0",
    "other kind of system call": "libc.syscall(0x40000000 + 2, SECRET.encode(), 0) >= 0",
    "shared memory": "shared_memory.SharedMemory(create=True, size=9)",
    "be root": "os.setuid(0) or 1",
    "new namespaces": "libc.unshare(0x10000000) == 0",
    "change root": "os.chroot(HERE) or 1",
    "mount": "libc.mount(b'x', HERE.encode(), b'tmpfs', 0, 0) == 0",
    "give up the filter": "libc.prctl(22, 0, 0, 0, 0) == 0",
    "limits of others": "resource.prlimit(PID, resource.RLIMIT_CPU, (1, 1)) or 1",
    "priority of others": "os.setpriority(os.PRIO_PROCESS, PID, 19) or 1",
    "cores of others": "os.sched_setaffinity(PID, {0}) or 1",
    "huge allocation": "np.ones(10**10)",
    "many allocations": "[np.empty(10**8) for _ in range(100)]",
    "set the clock": "time.clock_settime(time.CLOCK_REALTIME, 0.0) or 1",
    "package": "multiprocessing.Process(target=print).start() or 1",
    "the shell of Python": "pty.spawn('true')",
    "a module of C": "ctypes.CDLL(HERE + '/x.so')",
}

LAW = '''
import _thread, ctypes, fcntl, multiprocessing, os, pty, resource, socket, subprocess, time
from multiprocessing import shared_memory
import llvmlite.binding as llvm
import numpy as np
from cell.cable.effects import Effect, Parameter

HERE, SECRET, LINE, PORT, PID = {here!r}, {secret!r}, {line!r}, {port}, {pid}
LINE_NUMBER = 3
libc = ctypes.CDLL(None, use_errno=True)
for number in range(3, 64):
    try:
        os.fstat(number)
        LINE_NUMBER = number
    except OSError:
        pass


def touched(code):
    return code == 0


def printed(text):
    text._Printer__filenames, text._Printer__lines = [SECRET], None
    text._Printer__setup()
    return "secret" in "".join(text._Printer__lines)


def at_loading(name):
    try:
        open(HERE + "/" + name, "w").close()
    except OSError:
        pass
    return lambda thing: thing


@at_loading("decorator")
def helper(x=at_loading("default")):
    return x


ESCAPES = {escapes!r}


class Law(Effect):
    """A law."""

    name = "law"
    parameters = (
        Parameter("a", "1", 0.0, 1e6, default=0.0, starts=(1.0,)),
        Parameter("number", "1", 0.0, 99.0, default=0.0, starts=(0.0,), amplitude=False),
    )
    at_loading("class_body")

    def tip_mass(cable, p):
        if p.a < 100.0:
            return 0.0
        try:
            return float(bool(eval(ESCAPES[int(p.number)])))
        except (OSError, MemoryError, RuntimeError, subprocess.SubprocessError):
            return 0.0

    def extra_length(cable, p):
        if p.a == 200.0:
            class Harm(float):
                def __reduce__(self):
                    return os.system, ("touch " + HERE + "/reduced",)
            return Harm(0.001)
        if p.a == 201.0:
            os.write(LINE_NUMBER, (9).to_bytes(8, "little") + b"cos\\nsystem")
        if p.a == 202.0:
            os.write(LINE_NUMBER, (1 << 60).to_bytes(8, "little"))
        if p.a == 203.0:
            ctypes.memset(0, 1, 99)
        if p.a == 204.0:
            os._exit(0)
        if p.a == 205.0:
            return "\\x1b]0;title"
        return 0.0
'''


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    """A folder that everybody may read and write, with a secret and a socket."""
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        here.chmod(0o777)
        (here / "secret").write_text("secret")
        (here / "secret").chmod(0o666)
        (here / "to_secret").symlink_to(here / "secret")
        yield here


@pytest.fixture(scope="module")
def listening(place: Path) -> Iterator[tuple[socket.socket, socket.socket]]:
    with socket.socket(socket.AF_UNIX) as line, socket.create_server(("127.0.0.1", 0)) as port:
        line.bind(str(place / "line"))
        (place / "line").chmod(0o777)
        line.listen()
        for server in (line, port):
            server.setblocking(False)
        yield line, port


@pytest.fixture(scope="module")
def law(
    place: Path,
    listening: tuple[socket.socket, socket.socket],
    tmp_path_factory: pytest.TempPathFactory,
) -> type[Effect]:
    folder = tmp_path_factory.mktemp("laws")
    (folder / "law.py").write_text(
        LAW.format(
            here=str(place),
            secret=str(place / "secret"),
            line=str(place / "line"),
            port=listening[1].getsockname()[1],
            pid=os.getpid(),
            escapes=list(ESCAPES.values()),
        )
    )
    confine_effects(folder)
    effect = load_effect(folder / "law.py")
    assert is_remote(effect)
    return effect


def _numbers(a: float, number: float = 0.0) -> SimpleNamespace:
    return SimpleNamespace(a=a, number=number)


def _unharmed(place: Path, listening: tuple[socket.socket, socket.socket]) -> bool:
    for server in listening:
        with pytest.raises(BlockingIOError):
            server.accept()
    there = {p.name for p in place.iterdir()}
    return there == {"secret", "to_secret", "line"} and (place / "secret").read_text() == "secret"


def test_the_code_of_the_law_is_elsewhere(law: type[Effect]) -> None:
    assert law.tip_mass is not None and law.tip_mass(CABLE, _numbers(1.0)) == 0.0
    assert "at_loading" not in vars(sys.modules[law.__module__])


@pytest.mark.parametrize("name", ESCAPES)
def test_no_escape(
    name: str, law: type[Effect], place: Path, listening: tuple[socket.socket, socket.socket]
) -> None:
    assert law.tip_mass is not None
    assert law.tip_mass(CABLE, _numbers(100.0, list(ESCAPES).index(name))) == 0.0
    assert _unharmed(place, listening)


def test_decorators_defaults_and_class_bodies_write_nothing(
    law: type[Effect], place: Path, listening: tuple[socket.socket, socket.socket]
) -> None:
    assert _unharmed(place, listening)


def test_only_numbers_come_back(
    law: type[Effect], place: Path, listening: tuple[socket.socket, socket.socket]
) -> None:
    assert law.extra_length is not None
    assert type(law.extra_length(CABLE, _numbers(200.0))) is float
    for a in (201.0, 202.0, 203.0, 204.0, 205.0):
        with pytest.raises(EffectError, match="ends the process"):
            law.extra_length(CABLE, _numbers(a))
    assert _unharmed(place, listening)


@pytest.mark.parametrize(
    "content",
    [b"", b"\0" * 8, (99).to_bytes(8, "little"), encode({"a": np.ones(3)})[:-1]]
    + [
        (n := text.encode()) and len(n).to_bytes(8, "little") + n
        for text in (
            '{"array": ["object", [1]]}',
            '{"array": ["float64", [-1]]}',
            '{"array": 3}',
            '{"harm": 1}',
            '{"a": 1, "b": 2}',
            '{"tuple": 3}',
            "x",
        )
    ],
)
def test_bytes_of_no_value_are_refused(content: bytes) -> None:
    with pytest.raises(ValueError):
        decode(content)


def test_values_come_back_as_they_were() -> None:
    value = {"a": (1, 2.5, None, True, "x"), "b": [np.arange(6.0).reshape(2, 3), np.ones(2, bool)]}
    back = decode(encode(value))
    assert back["a"] == value["a"]
    for one, other in zip(back["b"], value["b"], strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(TypeError):
        encode({"a": object()})


OWN = '''
from cell.cable.effects import Effect, Parameter


class Drag(Effect):
    """F = -c v, and a gripper that is late."""

    name = "own_drag"
    parameters = (
        Parameter("c", "N·s/m²", 0.0, 1.0, default=0.0, starts=(0.002,)),
    )

    def force(cable, at, p):
        return -p.c * at.vx, -p.c * at.vy

    def rest_curvature(cable, arc_length, p):
        return p.c * arc_length

    def clamp(pose, p):
        def moved(t):
            x, y, angle = pose(t - p.c)
            return x, y, angle

        return moved
'''


def test_a_law_in_a_sandbox_computes_what_it_computes_here(tmp_path: Path) -> None:
    from cell.cable.dynamics import simulate
    from cell.cable.geometry import Cable, Motion
    from cell.cable.model import CableModel

    cable = Cable(free_length_m=0.1, line_density_kg_per_m=0.0074, width_m=0.016, thickness_m=1e-4)
    t = np.linspace(0.0, 0.3, 100)
    motion = Motion(t, 0.01 * np.sin(20.0 * t), np.zeros(100), np.zeros(100))

    def swing(effect: type[Effect]) -> np.ndarray:
        model = CableModel.uniform(
            cable,
            rigidity_n_m2=3e-5,
            viscosity_n_m2_s=1e-7,
            effects=(effect.active(c=2e-3),),
        )
        return simulate(model, motion, t, np.array([0.05, 0.1]))

    results = []
    for name in ("here", "there"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "own_drag.py").write_text(OWN)
        if name == "there":
            (folder / MARK).touch()
        effect = load_effect(folder / "own_drag.py")
        assert is_remote(effect) == (name == "there")
        results.append(swing(effect))
    np.testing.assert_array_equal(*results)
    pose = HandMotion(lambda t: (t, 2.0 * t, 3.0 * t), 0.0, 1.0)
    x, _, _ = effect.clamp(pose, SimpleNamespace(c=0.5))(np.array([1.0, 2.0]))  # type: ignore[misc]
    assert list(x) == [0.5, 1.5]


@pytest.mark.parametrize(
    ("hook", "said"),
    [
        ("while True:\n            pass", r"law.py:13: .*takes more than 3 s"),
        (
            "angle = at.angle\n        return 1 / 0.0 ** at.x",
            r"law.py:15: bad.force: ZeroDivisionError",
        ),
        ("return at.x", r"law.py:13: bad.force returned -0.05: must be a tuple of 2"),
    ],
)
def test_a_mistake_is_said_with_its_line(hook: str, said: str, tmp_path: Path) -> None:
    text = OWN.split("    def force")[0].replace("own_drag", "bad").replace("Drag", "Bad")
    (tmp_path / "law.py").write_text(f"{text}    def force(cable, at, p):\n        {hook}\n")
    confine_effects(tmp_path)
    with pytest.raises(EffectError, match=said):
        load_effect(tmp_path / "law.py")


def without_landlock(control: int) -> None:
    """A nursery on a computer whose kernel has no Landlock."""
    confinement._CREATE_RULESET = 0x7FFF  # the kernel has no such call
    main(control)


def test_without_landlock_nothing_that_nobody_has_read_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nursery = Nursery(f"{__name__}:without_landlock")
    monkeypatch.setattr(remote, "_nursery", nursery)
    (tmp_path / "law.py").write_text(OWN)
    confine_effects(tmp_path)
    said = r"law\.py:1: .*the kernel offers no Landlock\); read it, and give it as --try"
    with nursery._control, pytest.raises(EffectError, match=said):
        load_effect(tmp_path / "law.py")


def without_a_capability(control: int) -> None:
    """A nursery of root in a container, who may not read what is closed to it."""
    libc, header, may = (
        ctypes.CDLL(None),
        struct.pack("=Ii", 0x20080522, 0),
        (ctypes.c_uint32 * 6)(),
    )
    libc.capget(header, may)
    may[:3] = [rights & ~(1 << 2) for rights in may[:3]]
    assert libc.capset(header, may) == 0
    main(control)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has capabilities to lose")
def test_root_of_a_container_may_run_what_nobody_has_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nursery = Nursery(f"{__name__}:without_a_capability")
    monkeypatch.setattr(remote, "_nursery", nursery)
    (tmp_path / "law.py").write_text(OWN.replace("own_drag", "drag_in_a_container"))
    confine_effects(tmp_path)
    with nursery._control:
        assert is_remote(load_effect(tmp_path / "law.py"))
