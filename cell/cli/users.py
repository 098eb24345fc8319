"""The commands of users: user add, user remove, user list."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.shared import MaybeConfig, group, needing, refuse


def typed_password() -> str:
    """Read a password: asked for twice at a terminal, else the first line of standard input."""
    if sys.stdin.isatty():
        return str(typer.prompt("Password", hide_input=True, confirmation_prompt=True))
    return sys.stdin.readline().rstrip("\r\n")


app = group()

Name = Annotated[str, typer.Argument(help="Name of the user.")]
UsersFile = Annotated[Path, typer.Option("--users", help="File of the users.")]
RoleName = Annotated[str, typer.Option(help="watch, operate or engineer.")]
#: As `cell.plant.users.FILE`, which is not imported for the help.
FILE = Path("users.json")


@app.command()
def add(
    name: Name, *, role: RoleName = "watch", users: UsersFile = FILE, config: MaybeConfig = None
) -> None:
    """Add a user of pages and OPC UA, or give one another role and password.

    The password is asked for; without a terminal it is the first line of the standard input.  Only
    its hash is kept, in a file that only its owner can read.
    """
    add_user(users, name, role, opcua_folder(config))


@app.command()
def remove(name: Name, *, users: UsersFile = FILE, config: MaybeConfig = None) -> None:
    """Remove a user, whose sessions at the pages end."""
    remove_user(users, name, opcua_folder(config))


@app.command("list")
def list_(*, users: UsersFile = FILE, config: MaybeConfig = None) -> None:
    """List all users with their roles."""
    from cell.plant.users import all_users

    try:
        for user in all_users(users, opcua_folder(config)).all():
            print(f"{user.name}: may {user.role.name}")
    except (OSError, ValueError) as error:
        refuse(error)


def add_user(file: Path, name: str, role: str, folder: Path | None) -> None:
    """Do `user add`; `folder` is the older users' folder of OPC UA, which is read, too."""
    from cell.plant.users import Role, all_users

    try:
        if role not in Role.__members__:
            raise ValueError(f"--role {role}: no role; give one of {', '.join(Role.__members__)}")
        with needing("web", "users need", "argon2"):
            new = all_users(file, folder).add(name, Role[role], typed_password())
        print(f"{name}: {'added' if new else 'changed'}, may {role}")
    except (OSError, ValueError) as error:
        refuse(error)


def remove_user(file: Path, name: str, folder: Path | None) -> None:
    """Do `user remove`."""
    from cell.plant.users import all_users

    try:
        all_users(file, folder).remove(name)
        print(f"{name}: removed")
    except (OSError, ValueError) as error:
        refuse(error)


def opcua_folder(config: Path | None) -> Path | None:
    """Folder of the OPC UA server in the settings; None = no settings, or none in them."""
    from cell.settings import InputError, load_settings

    if config is None:
        return None
    try:
        plant = load_settings(config).plant
    except InputError as error:
        refuse(error)
    return None if plant is None or plant.opcua is None else plant.opcua.folder
