"""The commands of the pages, and of the users of pages and OPC UA: serve, user."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import Runs, taking
from cell.cli.shared import MaybeConfig, group, needing, refuse, refusing

if TYPE_CHECKING:
    from cell.web.visit import PagesContext

app = group("serve")
#: Also below `cell serve` and `cell opcua`.
users_app = group(help="Users of pages and OPC UA.")
app.add_typer(users_app, name="user")

Name = Annotated[str, typer.Argument(help="Name of the user.")]
UsersFile = Annotated[Path, typer.Option("--users", help="File of the users.")]
#: As `cell.plant.users.FILE`, which is not imported for the help.
FILE = Path("users.json")


@dataclass(frozen=True)
class ServeOptions:
    """Where the pages are served, and with what."""

    context: typer.Context
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Settings of the cell, YAML; needed for the pages."),
    ] = None
    runs: Runs = Path("runs")
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1"
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen at.")] = 8080
    certificate: Annotated[Path | None, typer.Option(help="Certificate of TLS, PEM.")] = None
    key: Annotated[Path | None, typer.Option(help="Key of the certificate, PEM.")] = None
    users: UsersFile = FILE
    metrics_token: Annotated[
        Path | None,
        typer.Option(
            help="File with the token by which Prometheus reads /metrics without a login."
        ),
    ] = None


@app.callback()
@taking(ServeOptions)
def serve(options: ServeOptions) -> None:
    """Serve the pages of a cell for browsers, until Ctrl-C.

    It is a process of its own beside `cell run`: whatever happens to it, the cell goes on.  On
    loopback, accounts and TLS are optional: once there are users, everybody logs in.  Any other
    address needs both.

    Exit codes: 0; 2 if the settings or options are wrong, or the address is taken.
    """
    if options.context.invoked_subcommand is not None:
        return
    packages = "nicegui", "argon2", "fastapi", "starlette", "uvicorn", "prometheus_client"
    try:
        if options.config is None:
            raise ValueError("--config is missing: name the settings of the cell")
        with needing("web", "the pages need", *packages):
            _serve(options, options.config)
    except (OSError, ValueError) as error:
        refuse(error)


def _serve(at: ServeOptions, config: Path) -> None:
    """Serve until the end.  Raises ValueError, OSError: it cannot be done so."""
    from cell.files.atomic import read_secret
    from cell.plant.users import all_users
    from cell.web.guard import LOOPBACK
    from cell.web.serve import may_be_served
    from cell.web.serve import serve as serve_pages

    folder = opcua_folder(config)
    accounts = all_users(at.users, folder)
    loopback = at.host in LOOPBACK
    if (at.certificate is None) != (at.key is None):
        raise ValueError("--certificate and --key go together; give both")
    tls = None if at.certificate is None or at.key is None else (at.certificate, at.key)
    if tls is not None:
        _check_certificate(*tls)
    refused = may_be_served(at.host, tls is not None, len(accounts), loopback)
    if refused:
        raise ValueError(refused)
    token = "" if at.metrics_token is None else read_secret(at.metrics_token, "--metrics-token")
    _check_address(at.host, at.port)
    room = _room(config, at.runs, accounts if not loopback or len(accounts) else None)
    print(f"{'http' if tls is None else 'https'}://{at.host}:{at.port}", flush=True)
    serve_pages(room, accounts, (at.host, at.port), tls, token)


def _check_certificate(certificate: Path, key: Path) -> None:
    """Raises ValueError: the two cannot be read, or do not belong together."""
    import ssl

    from cell.files.text_file import read_text

    for file in (certificate, key):
        read_text(file, 1_000_000)
    try:
        ssl.create_default_context().load_cert_chain(certificate, key, password=lambda: b"")
    except OSError as error:
        raise ValueError(
            f"--certificate {certificate}, --key {key}: {error.strerror}; give a certificate and "
            "its key without a passphrase, PEM"
        ) from error


def _check_address(host: str, port: int) -> None:
    """Raises ValueError: this computer does not have the address, or it is taken."""
    import socket

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((host, port))
    except OSError as error:
        raise ValueError(
            f"--host {host}, --port {port}: {error.strerror}; give another --port, or an address "
            "of this computer"
        ) from error


def _room(config: Path, runs: Path, accounts: object) -> PagesContext:
    """What the pages share.  Raises InputError: the settings are wrong."""
    from cell.plant.client import Client
    from cell.plant.users import Users
    from cell.settings import load_settings
    from cell.web.sessions import Sessions
    from cell.web.visit import PagesContext
    from cell.web.watching import CellWatch

    settings = load_settings(config)
    client = Client(runs, on_lost=lambda: watch.lost(), on_there=lambda: watch.reconnected())
    watch = CellWatch(client, settings, runs)
    sessions = Sessions(accounts.named) if isinstance(accounts, Users) else None
    return PagesContext(config, settings, runs, client, watch, sessions)


def typed_password() -> str:
    """Read a password: asked for twice at a terminal, else the first line of standard input."""
    if sys.stdin.isatty():
        return str(typer.prompt("Password", hide_input=True, confirmation_prompt=True))
    return sys.stdin.readline().rstrip("\r\n")


@users_app.command()
def add(
    name: Name,
    *,
    role: Annotated[str, typer.Option(help="watch, operate or engineer.")] = "watch",
    users: UsersFile = FILE,
    config: MaybeConfig = None,
) -> None:
    """Add a user of pages and OPC UA, or give one another role and password.

    The password is asked for; without a terminal it is the first line of the standard input.  Only
    its hash is kept, in a file that only its owner can read.
    """
    from cell.plant.users import Role, all_users

    folder = opcua_folder(config)
    try:
        if role not in Role.__members__:
            raise ValueError(f"--role {role}: no role; give one of {', '.join(Role.__members__)}")
        with needing("web", "users need", "argon2"):
            new = all_users(users, folder).add(name, Role[role], typed_password())
        print(f"{name}: {'added' if new else 'changed'}, may {role}")
    except (OSError, ValueError) as error:
        refuse(error)


@users_app.command()
def remove(name: Name, *, users: UsersFile = FILE, config: MaybeConfig = None) -> None:
    """Remove a user, whose sessions at the pages end; those of OPC UA stay."""
    from cell.plant.users import all_users

    folder = opcua_folder(config)
    try:
        all_users(users, folder).remove(name)
        print(f"{name}: removed")
    except (OSError, ValueError) as error:
        refuse(error)


@users_app.command("list")
def list_(*, users: UsersFile = FILE, config: MaybeConfig = None) -> None:
    """List all users with their roles."""
    from cell.plant.users import all_users

    folder = opcua_folder(config)
    try:
        for user in all_users(users, folder).all():
            print(f"{user.name}: may {user.role.name}")
    except (OSError, ValueError) as error:
        refuse(error)


def opcua_folder(config: Path | None) -> Path | None:
    """Folder of the OPC UA server in the settings; None = no settings, or none in them."""
    from cell.settings import load_settings

    if config is None:
        return None
    with refusing():
        plant = load_settings(config).plant
    return None if plant is None or plant.opcua is None else plant.opcua.folder
