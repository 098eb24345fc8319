"""Users of the OPC UA server: a file with their roles and hashes of their passwords."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from cell.files.input_error import InputError
from cell.plant.opcua.secret_file import write_secret

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
#: Shorter passwords are refused, characters.
SHORTEST = 8
_HASHER = PasswordHasher()


class Role(StrEnum):
    """What a user may do: look, or also command."""

    WATCH = "watch"
    OPERATE = "operate"


@dataclass(frozen=True)
class UserEntry:
    """A user as the file has it; `hash` by Argon2id, salt included."""

    role: Role
    hash: str


def users_file(folder: Path) -> Path:
    """The file of users in the folder of the settings."""
    return folder / "users.json"


def read_users(folder: Path) -> dict[str, UserEntry]:
    """All users by name; without a file none.  Raises InputError: the file is damaged."""
    path = users_file(folder)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    try:
        return {n: UserEntry(Role(u["role"]), str(u["hash"])) for n, u in json.loads(text).items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError.at(
            path, f"is damaged ({error}); remove it and add its users again"
        ) from error


def add_user(folder: Path, name: str, role: Role, password: str) -> bool:
    """Add a user, or change role and password of one; whether it is a new one.

    raises  InputError: not a name, or too short a password; OSError
    """
    path = users_file(folder)
    if not _NAME.fullmatch(name):
        raise InputError.at(path, f"{name!r} is no name of a user; use letters, digits and . _ @ -")
    if len(password) < SHORTEST:
        raise InputError.at(
            path, f"a password has at least {SHORTEST} characters; give a longer one"
        )
    users = read_users(folder)
    entry = UserEntry(role, _HASHER.hash(password))
    _write(path, {**users, name: entry})
    return name not in users


def remove_user(folder: Path, name: str) -> None:
    """Remove a user.  Raises InputError: there is none of this name; OSError."""
    users = read_users(folder)
    if name not in users:
        known = ", ".join(sorted(users)) or "none"
        raise InputError.at(users_file(folder), f"has no user {name!r}; users are: {known}")
    _write(users_file(folder), {n: u for n, u in users.items() if n != name})


def role_of(users: dict[str, UserEntry], name: str, password: str) -> Role | None:
    """Role of a user; None = no such user, or the wrong password, which takes as long to find."""
    entry = users.get(name)
    try:
        _HASHER.verify(_nobody() if entry is None else entry.hash, password)
    except (InvalidHashError, VerificationError):
        return None
    return None if entry is None else entry.role


@cache
def _nobody() -> str:
    """Hash that a password is compared with where there is no such user."""
    return _HASHER.hash("nobody has this password")


def _write(path: Path, users: dict[str, UserEntry]) -> None:
    text = json.dumps({n: asdict(u) for n, u in sorted(users.items())}, indent=2)
    write_secret(path, f"{text}\n".encode())
