"""Users of pages and OPC UA: names, roles, password hashes, in a file only its owner can read."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

from cell.files.atomic import write_secret

_Row = Mapping[str, str]

#: A shorter password is refused, characters.
LEAST_PASSWORD = 10
#: A longer one, too: hashing it would take its time.
MOST_PASSWORD = 1000
_NAME = re.compile(r"[\w.@-]{1,60}")
#: Hash of no password, so that an unknown name takes as long as a wrong password.
_NOBODY = (
    "$argon2id$v=19$m=65536,t=3,p=4$c29tZXNhbHRzb21lc2FsdA"
    "$S8vCf1Jt3cEgVTtMCkkYxZjLFOJdgZ0GF6yWuWRQwWY"
)


#: The file of all users, in the folder in which the programs are started.
FILE = Path("users.json")


class Role(IntEnum):
    """Rights of a person; a higher role includes the lower ones."""

    watch = 1
    operate = 2
    engineer = 3


@dataclass(frozen=True)
class User:
    """A person who has an account."""

    name: str
    role: Role


class Users:
    """Accounts in a file, which is read again for every query.

    older   files of earlier versions, whose users hold until they are changed or removed here
    raises  ValueError, from every method: a file is no file of users, or others may read it
    """

    def __init__(self, file: Path, older: Sequence[Path] = ()) -> None:
        self.file = file
        self._older = tuple(dict.fromkeys(p for p in older if p != file))

    def add(self, name: str, role: Role, password: str) -> bool:
        """Add a user or change one; whether it is new.  Raises ValueError; OSError."""
        from argon2 import PasswordHasher

        if not _NAME.fullmatch(name):
            raise ValueError(f"{name!r}: a name has 1 to 60 letters, digits, or one of . @ - _")
        if not LEAST_PASSWORD <= len(password) <= MOST_PASSWORD:
            raise ValueError(f"a password has {LEAST_PASSWORD} to {MOST_PASSWORD} characters")
        new = name not in self._read()
        own, removed = _content(self.file)
        own[name] = {"role": role.name, "hash": PasswordHasher().hash(password)}
        self._write(own, removed - {name})
        return new

    def remove(self, name: str) -> None:
        """Remove a user, whose sessions end.  Raises ValueError: there is none of this name."""
        known = self._read()
        if name not in known:
            there = ", ".join(sorted(known)) or "none"
            raise ValueError(f"{self.file}: has no user {name!r}; users are: {there}")
        own, removed = _content(self.file)
        own.pop(name, None)
        self._write(own, removed | {name})

    def all(self) -> tuple[User, ...]:
        """All users, by name."""
        return tuple(User(n, Role[row["role"]]) for n, row in sorted(self._read().items()))

    def named(self, name: str) -> User | None:
        """The user of a name; None = there is none."""
        row = self._read().get(name)
        return None if row is None else User(name, Role[row["role"]])

    def authenticate(self, name: str, password: str) -> User | None:
        """The user, if the password is right; else None, after the same time."""
        from argon2 import PasswordHasher
        from argon2.exceptions import Argon2Error, InvalidHashError

        row = self._read().get(name)
        try:
            hashed = _NOBODY if row is None else row["hash"]
            PasswordHasher().verify(hashed, password[: MOST_PASSWORD + 1])
        except (Argon2Error, InvalidHashError):
            return None
        return None if row is None else User(name, Role[row["role"]])

    def __len__(self) -> int:
        return len(self._read())

    def _read(self) -> dict[str, _Row]:
        own, removed = _content(self.file)
        users: dict[str, _Row] = {}
        for path in reversed(self._older):
            users |= {n: row for n, row in _content(path)[0].items() if n not in removed}
        return users | own

    def _write(self, users: Mapping[str, _Row], removed: Collection[str]) -> None:
        data = {"users": users, "removed": sorted(removed)}
        text = json.dumps(data, indent=2, ensure_ascii=False)
        write_secret(self.file, f"{text}\n".encode())


def all_users(file: Path = FILE, opcua_folder: Path | None = None) -> Users:
    """Users of pages and OPC UA, including those of earlier versions' files.

    opcua_folder  of the OPC UA server; None = `opcua` next to the file
    """
    folder = file.with_name("opcua") if opcua_folder is None else opcua_folder
    return Users(file, (file.with_name("web-users.json"), folder / "users.json"))


def _content(path: Path) -> tuple[dict[str, _Row], set[str]]:
    """Users of a file, and names that were removed; none without a file."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}, set()
    if path.stat().st_mode & 0o077:
        raise ValueError(f"{path}: others may read it; chmod 600 {path}")
    try:
        data = json.loads(text)
        # `cell opcua` of earlier versions has written the users alone
        wrapped = "users" in data and "role" not in data["users"]
        users = dict(data["users"] if wrapped else data)
        removed = {str(n) for n in data.get("removed", ())} if wrapped else set()
        assert all(row["role"] in Role.__members__ and row["hash"] for row in users.values())
    except (ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
        message = "is no file of users; remove it and add them again: cell user add"
        raise ValueError(f"{path}: {message}") from error
    return users, removed
