"""Users of the pages: names, roles and hashes of passwords, in a file that only its owner reads."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

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


class Role(IntEnum):
    """What a person may do; a higher role may do all that a lower one may."""

    watch = 1
    operate = 2
    engineer = 3


@dataclass(frozen=True)
class User:
    """A person who has an account."""

    name: str
    role: Role


class Users:
    """The accounts of a file, which is read anew for every question.

    raises  ValueError, from every method: the file is no file of users
    """

    def __init__(self, file: Path) -> None:
        self.file = file

    def add(self, name: str, role: Role, password: str) -> bool:
        """Add a user or change one; whether it is new.  Raises ValueError; OSError."""
        from argon2 import PasswordHasher

        if not _NAME.fullmatch(name):
            raise ValueError(f"{name!r}: a name has 1 to 60 letters, digits, or one of . @ - _")
        if not LEAST_PASSWORD <= len(password) <= MOST_PASSWORD:
            raise ValueError(f"a password has {LEAST_PASSWORD} to {MOST_PASSWORD} characters")
        known = dict(self._read())
        new = name not in known
        known[name] = {"role": role.name, "hash": PasswordHasher().hash(password)}
        self._write(known)
        return new

    def remove(self, name: str) -> None:
        """Remove a user, whose sessions end.  Raises ValueError: there is none of this name."""
        known = dict(self._read())
        if known.pop(name, None) is None:
            raise ValueError(f"{self.file}: has no user {name!r}")
        self._write(known)

    def named(self, name: str) -> User | None:
        """The user of a name; None = there is none."""
        row = self._read().get(name)
        return None if row is None else User(name, Role[row["role"]])

    def known(self, name: str, password: str) -> User | None:
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

    def _read(self) -> Mapping[str, Mapping[str, str]]:
        try:
            text = self.file.read_text(encoding="utf-8")
        except FileNotFoundError:
            return {}
        if self.file.stat().st_mode & 0o077:
            raise ValueError(f"{self.file}: others may read it; chmod 600 {self.file}")
        try:
            users = json.loads(text)["users"]
            assert all(row["role"] in Role.__members__ and row["hash"] for row in users.values())
        except (ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
            message = "is no file of users; remove it and add them again: cell serve user add"
            raise ValueError(f"{self.file}: {message}") from error
        return users  # type: ignore[no-any-return]

    def _write(self, users: Mapping[str, Mapping[str, str]]) -> None:
        new = self.file.with_name(f".{self.file.name}.{os.getpid()}")
        new.unlink(missing_ok=True)
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as out:
            json.dump({"users": users}, out, indent=2, ensure_ascii=False)
            out.flush()
            os.fsync(out.fileno())
        new.replace(self.file)
