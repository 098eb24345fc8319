"""The commands of the OPC UA server: opcua, opcua user add, opcua user remove."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.passwords import typed_password
from cell.cli.shared import BAD_INPUT, Config, MaybeConfig, group, refuse

if TYPE_CHECKING:
    from cell.settings import Settings

app = typer.Typer(
    name="opcua",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
user = group()
app.add_typer(user, name="user", help="Users of the OPC UA server.")

Name = Annotated[str, typer.Argument(help="Name of the user.")]


@app.callback()
def opcua(
    context: typer.Context,
    config: MaybeConfig = None,
    runs: Annotated[
        Path, typer.Option(help="Folder of the records of the cell that is shown.")
    ] = Path("runs"),
) -> None:
    """Show a running cell to a plant by OPC UA, after PackML, until Ctrl-C.

    It is a process of its own beside `cell run`: whatever happens to it, the cell goes on.  It may
    begin before the cell, and stays when the cell ends.

    Exit codes: 0; 2 if the settings are wrong or its address is taken.
    """
    if context.invoked_subcommand is not None:
        return
    if config is None:
        print("--config is missing: the settings of the cell", file=sys.stderr)
        raise typer.Exit(BAD_INPUT)
    try:
        settings = _settings(config)
        from cell.plant.opcua.server import serve
        from cell.terminal.logs import to_file, warnings_to_terminal

        warnings_to_terminal()

        if settings.plant is not None and settings.plant.opcua is not None:
            to_file(settings.plant.opcua.folder / "opcua.log")
        serve(settings, runs, lambda address: print(f"listens at {address}", flush=True))
    except ImportError as error:
        _without_extra(error)
    except ValueError as error:
        refuse(error)


@user.command()
def add(
    name: Name,
    *,
    config: Config,
    role: Annotated[
        str, typer.Option(help="watch: only look; operate: also start, stop and the others.")
    ] = "watch",
) -> None:
    """Add a user, or give one another role and password.

    The password is asked for; without a terminal it is the first line of the standard input.  Only
    its hash is kept, in the folder `plant.opcua.folder`.
    """
    try:
        from cell.plant.opcua.users import Role, add_user

        folder = _folder(config)
        if role not in {r.value for r in Role}:
            raise ValueError(f"--role {role}: no role; give {' or '.join(Role)}")
        new = add_user(folder, name, Role(role), typed_password())
        print(f"{name}: {'added' if new else 'changed'}, may {role}")
    except ImportError as error:
        _without_extra(error)
    except (OSError, ValueError) as error:
        refuse(error)


@user.command()
def remove(name: Name, *, config: Config) -> None:
    """Remove a user; sessions that are open stay until they end."""
    try:
        from cell.plant.opcua.users import remove_user

        remove_user(_folder(config), name)
        print(f"{name}: removed")
    except ImportError as error:
        _without_extra(error)
    except (OSError, ValueError) as error:
        refuse(error)


def _settings(config: Path) -> Settings:
    from cell.settings import load_settings

    return load_settings(config)


def _folder(config: Path) -> Path:
    """Folder of the users.  Raises ValueError: the settings have no server."""
    plant = _settings(config).plant
    if plant is None or plant.opcua is None:
        raise ValueError(f"{config}: has no section plant.opcua; add one, it may be empty: {{}}")
    return plant.opcua.folder


def _without_extra(error: ImportError) -> None:
    if (error.name or "").partition(".")[0] not in ("asyncua", "argon2", "cryptography"):
        raise error
    refuse(ValueError(f"OPC UA needs {error.name}: pip install 'cable-cell[opcua]'"))
