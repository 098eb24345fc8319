"""The commands of the OPC UA server: opcua, opcua user add, opcua user remove."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import records_folder
from cell.cli.shared import BAD_INPUT, Config, MaybeConfig, group, refuse
from cell.cli.users import FILE, Name, RoleName, UsersFile, add_user, opcua_folder, remove_user
from drivers.installing import install_extra

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


@app.callback()
def opcua(
    context: typer.Context,
    config: MaybeConfig = None,
    runs: Annotated[
        Path,
        typer.Option(
            help="Folder of the records of the cell that is shown.", callback=records_folder
        ),
    ] = Path("runs"),
    users: UsersFile = FILE,
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
        from cell.cli.logs import to_file, warnings_to_terminal
        from cell.plant.opcua.server import serve

        warnings_to_terminal()

        if settings.plant is not None and settings.plant.opcua is not None:
            to_file(settings.plant.opcua.folder / "opcua.log")
        serve(settings, runs, lambda address: print(f"listens at {address}", flush=True), users)
    except ImportError as error:
        _without_extra(error)
    except ValueError as error:
        refuse(error)


@user.command()
def add(name: Name, *, config: Config, role: RoleName = "watch", users: UsersFile = FILE) -> None:
    """Add a user: the same as `cell user add`."""
    add_user(users, name, role, _folder(config))


@user.command()
def remove(name: Name, *, config: Config, users: UsersFile = FILE) -> None:
    """Remove a user: the same as `cell user remove`.  Sessions that are open stay."""
    remove_user(users, name, _folder(config))


def _settings(config: Path) -> Settings:
    from cell.settings import load_settings

    return load_settings(config)


def _folder(config: Path) -> Path:
    """Folder of the server; settings without one are refused."""
    folder = opcua_folder(config)
    if folder is None:
        said = f"{config}: has no section plant.opcua; add one, it may be empty: {{}}"
        refuse(ValueError(said))
    return folder


def _without_extra(error: ImportError) -> None:
    if (error.name or "").partition(".")[0] not in ("asyncua", "argon2", "cryptography"):
        raise error
    refuse(ValueError(f"OPC UA needs {error.name}: {install_extra('opcua')}"))
