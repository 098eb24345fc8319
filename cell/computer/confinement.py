"""Takes from a process all that it does not need to compute, by the kernel and for good.

Landlock lets it read the folders of programs and nothing else; seccomp lets it make no file,
socket, process or signal; limits bound its memory and time; root becomes nobody.  Landlock and
seccomp need no privilege.  A process is confined before it runs anything that nobody has read.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import signal
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

#: Memory that a confined process may have, bytes; numba's libraries are mapped into most of it.
MEMORY_BYTES = 4 * 1024**3
#: CPU time that it may take in all, s.
CPU_S = 3600
#: Files that it may have open.
_FILES = 64
#: Who nobody is.
_NOBODY = 65534

_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _PR_SET_DUMPABLE, _PR_SET_KEEPCAPS = 38, 22, 4, 8
_PR_SET_PDEATHSIG = 1
#: Version of capabilities, and the only one retained: programs may be in root's own folder.
_CAPABILITIES, _DAC_READ_SEARCH = 0x20080522, 1 << 2
_SECCOMP_MODE_FILTER = 2
#: Numbers of system calls that are the same on all computers.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
#: Of Landlock: rights to files by version, to the network and to other processes.
_FILE_RIGHTS = {1: 0x1FFF, 2: 0x3FFF, 3: 0x7FFF, 4: 0x7FFF}
_NEWEST_FILE_RIGHTS, _NET_RIGHTS, _SCOPES = 0xFFFF, 0x3, 0x3
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
#: Rights that a file has, not only a folder: to run, write, read, cut and control it.
_OF_FILE = 0b111 | 1 << 14 | 1 << 15
#: `open` for reading, with flags that change nothing.
_READING = os.O_CLOEXEC | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | 0o100000
#: `fcntl` by which no process gets a signal.
_FCNTL = (1, 2, 3)  # F_GETFD, F_SETFD, F_GETFL

#: System calls of computing, compiling and importing, by architecture; others fail with EPERM.
_CALLS: dict[str, dict[str, int]] = {
    "x86_64": {
        **{"read": 0, "write": 1, "close": 3, "stat": 4, "fstat": 5, "lstat": 6, "lseek": 8},
        **{"mmap": 9, "mprotect": 10, "munmap": 11, "brk": 12, "rt_sigaction": 13},
        **{"rt_sigprocmask": 14, "rt_sigreturn": 15, "pread64": 17, "readv": 19, "access": 21},
        **{"sched_yield": 24, "mremap": 25, "madvise": 28, "nanosleep": 35, "getpid": 39},
        **{"exit": 60, "uname": 63, "getcwd": 79, "readlink": 89, "getuid": 102, "getgid": 104},
        **{"geteuid": 107, "getegid": 108, "sigaltstack": 131, "gettid": 186, "futex": 202},
        **{"sched_getaffinity": 204, "getdents64": 217, "clock_gettime": 228},
        **{"clock_nanosleep": 230, "exit_group": 231, "newfstatat": 262, "readlinkat": 267},
        **{"faccessat": 269, "getrandom": 318, "statx": 332, "faccessat2": 439},
    },
    "aarch64": {
        **{"getcwd": 17, "faccessat": 48, "close": 57, "getdents64": 61, "lseek": 62, "read": 63},
        **{"write": 64, "readv": 65, "pread64": 67, "readlinkat": 78, "newfstatat": 79},
        **{"fstat": 80, "exit": 93, "exit_group": 94, "futex": 98, "nanosleep": 101},
        **{"clock_gettime": 113, "clock_nanosleep": 115, "sched_getaffinity": 123},
        **{"sched_yield": 124, "sigaltstack": 132, "rt_sigaction": 134, "rt_sigprocmask": 135},
        **{"rt_sigreturn": 139, "uname": 160, "getpid": 172, "getuid": 174, "geteuid": 175},
        **{"getgid": 176, "getegid": 177, "gettid": 178, "brk": 214, "munmap": 215},
        **{"mremap": 216, "mmap": 222, "mprotect": 226, "madvise": 233, "getrandom": 278},
        **{"statx": 291, "faccessat2": 439},
    },
}
#: (architecture of the audit, open, openat, fcntl); −1 = there is none.
_SPECIAL = {"x86_64": (0xC000003E, 2, 257, 72), "aarch64": (0xC00000B7, -1, 56, 25)}


class UnconfinedError(OSError):
    """This computer cannot confine a process.  Scenario: no Linux, or a kernel before 5.13."""


def confine(readable: Iterable[Path], parent: int) -> None:
    """Confine this process, for good.  To be called while it has one thread.

    readable  folders of programs, whose files it may read
    parent    process that made it, with which it ends
    raises    UnconfinedError: the kernel does not do all of it; the process must end then
    """
    machine = platform.machine()
    if sys.platform != "linux" or machine not in _CALLS:
        raise UnconfinedError(f"{sys.platform} on {machine} has no Landlock and seccomp known here")
    libc = ctypes.CDLL(None, use_errno=True)
    libc.syscall.restype = ctypes.c_long
    _limit()
    if os.geteuid() == 0:
        _become_nobody(libc)
    _prctl(libc, _PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    _prctl(libc, _PR_SET_DUMPABLE, 0)
    _prctl(libc, _PR_SET_NO_NEW_PRIVS, 1)
    _restrict_files(libc, readable)
    _restrict_calls(libc, machine)


def hide(*places: Path) -> None:
    """Hide places from this process and all that it starts, for good; other processes, too.

    Files next to them, or next to a folder above, stay unchanged; none can be created there.
    raises    UnconfinedError: the kernel offers no Landlock
    """
    if sys.platform != "linux":
        raise UnconfinedError(f"{sys.platform} has no Landlock known here")
    libc = ctypes.CDLL(None, use_errno=True)
    libc.syscall.restype = ctypes.c_long
    processes = {*Path("/proc").glob("[0-9]*")} - {Path(f"/proc/{os.getpid()}")}
    hidden = {place.resolve() for place in (*places, *processes)}
    above = {parent for place in hidden for parent in place.parents}
    others = {each.resolve() for parent in above for each in parent.iterdir()} - above
    others = {each for each in others if hidden.isdisjoint((each, *each.parents))}
    _prctl(libc, _PR_SET_NO_NEW_PRIVS, 1)
    _restrict_files(libc, others, _NEWEST_FILE_RIGHTS)


def _limit() -> None:
    limits = {
        resource.RLIMIT_AS: MEMORY_BYTES,
        resource.RLIMIT_CPU: CPU_S,
        resource.RLIMIT_NOFILE: _FILES,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NPROC: 0,
    }
    for kind, most in limits.items():
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def _become_nobody(libc: ctypes.CDLL) -> None:
    """Become `nobody` with root's read access, which Landlock then restricts."""
    _prctl(libc, _PR_SET_KEEPCAPS, 1)
    os.setgroups([])
    os.setresgid(_NOBODY, _NOBODY, _NOBODY)
    os.setresuid(_NOBODY, _NOBODY, _NOBODY)
    header = struct.pack("=Ii", _CAPABILITIES, 0)
    had = (ctypes.c_uint32 * 6)()
    libc.capget(header, had)
    kept = had[1] & _DAC_READ_SEARCH  # root of a container may lack it, and rarely needs it
    if libc.capset(header, struct.pack("=6I", kept, kept, 0, 0, 0, 0)) != 0:
        raise UnconfinedError(ctypes.get_errno(), "capabilities cannot be given up")


def _prctl(libc: ctypes.CDLL, option: int, value: int) -> None:
    if libc.prctl(option, ctypes.c_ulong(value), 0, 0, 0) != 0:
        raise UnconfinedError(ctypes.get_errno(), f"prctl {option} is refused by the kernel")


def _restrict_files(
    libc: ctypes.CDLL, places: Iterable[Path], allowed: int = _READ_FILE | _READ_DIR
) -> None:
    """Permit only allowed accesses below some paths; no network and signals, if Landlock can."""
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    if version < 1:
        raise UnconfinedError(ctypes.get_errno(), "the kernel offers no Landlock")
    rights = _FILE_RIGHTS.get(version, _NEWEST_FILE_RIGHTS)
    fields = (rights, _NET_RIGHTS, _SCOPES)[: 1 if version < 4 else 2 if version < 6 else 3]
    ruleset = struct.pack(f"={len(fields)}Q", *fields)
    rules = libc.syscall(_CREATE_RULESET, ruleset, ctypes.c_size_t(len(ruleset)), 0)
    if rules < 0:
        raise UnconfinedError(ctypes.get_errno(), "Landlock makes no ruleset")
    for place in places:
        try:
            opened = os.open(place, os.O_PATH | os.O_CLOEXEC)
        except OSError:  # cannot be opened, so it is not read
            continue
        of_place = rights & allowed & (_NEWEST_FILE_RIGHTS if place.is_dir() else _OF_FILE)
        rule = struct.pack("=Qi", of_place, opened)
        if libc.syscall(_ADD_RULE, rules, 1, rule, 0) != 0:
            raise UnconfinedError(ctypes.get_errno(), f"Landlock takes no rule of {place}")
        os.close(opened)
    if libc.syscall(_RESTRICT_SELF, rules, 0) != 0:
        raise UnconfinedError(ctypes.get_errno(), "Landlock restricts nothing")
    os.close(rules)


def _restrict_calls(libc: ctypes.CDLL, machine: str) -> None:
    """Permit only the system calls of `_CALLS`, and `open` for reading."""
    program = _filter(machine)

    class Program(ctypes.Structure):
        _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_char_p))

    argument = Program(len(program) // 8, program)
    if libc.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(argument), 0, 0) != 0:
        raise UnconfinedError(ctypes.get_errno(), "the kernel offers no seccomp filter")


def _filter(machine: str) -> bytes:
    """Program of the filter: 8 bytes an instruction, of the kernel's classic BPF."""
    load, equal, larger, bits, back = 0x20, 0x15, 0x35, 0x45, 0x06
    allow, deny, kill = 0x7FFF0000, 0x00050001, 0x80000000  # deny: EPERM
    audit, opened, opened_at, controlled = _SPECIAL[machine]

    def step(code: int, value: int, yes: int = 0, no: int = 0) -> bytes:
        return struct.pack("=HBBI", code, yes, no, value)

    def argument(number: int) -> int:
        return 16 + 8 * number  # its low half, of little-endian computers

    steps = [step(load, 4), step(equal, audit, 1), step(back, kill)]
    steps += [step(load, 0), step(larger, 0x40000000, 0, 1), step(back, deny)]
    for call in _CALLS[machine].values():
        steps += [step(equal, call, 0, 1), step(back, allow)]
    for call, flags in ((opened, 1), (opened_at, 2)):
        if call >= 0:
            steps += [step(equal, call, 0, 4), step(load, argument(flags))]
            steps += [step(bits, ~_READING & 0xFFFFFFFF, 0, 1), step(back, deny)]
            steps += [step(back, allow)]
    steps += [step(equal, controlled, 0, 2 * len(_FCNTL) + 2), step(load, argument(1))]
    for command in _FCNTL:
        steps += [step(equal, command, 0, 1), step(back, allow)]
    steps += [step(back, deny), step(back, deny)]
    return b"".join(steps)
