"""Beyond this computer only known programs and people are let in, and not all may command."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path

import pytest
from asyncua import Client, ua

from cell.plant.opcua.certificates import own_certificate
from tests.cell.plant.opcua.conftest import PASSWORD, Seen, Site

MACHINE = "BaseStateMachine.MachineState"


def certificate_in(folder: Path) -> Path:
    """A client's certificate, its key beside it."""
    certificate, key = own_certificate(folder, "urn:test:client", "127.0.0.1")
    shutil.copy(key, certificate.with_suffix(".pem"))
    return certificate


@pytest.fixture(scope="module")
def known(beyond: Site, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificate of a client that the server trusts."""
    certificate = certificate_in(tmp_path_factory.mktemp("known"))
    shutil.copy(certificate, beyond.folder / "trusted" / "client.der")
    return certificate


def test_who_operates_commands_the_cell_under_their_name(beyond: Site, known: Path) -> None:
    async def command(seen: Seen) -> None:
        await seen.until("Cell.State", "stopped")
        assert await seen.call(f"{MACHINE}.Reset") == "Good"

    beyond.cell.asked.clear()
    beyond.look(command, user="ada", certificate=known)
    assert [r.by for r in beyond.cell.asked] == ["opcua:ada"]


def test_who_watches_reads_and_commands_nothing(beyond: Site, known: Path) -> None:
    async def watch(seen: Seen) -> None:
        assert isinstance(await seen.read("Cell.State"), str)
        assert await seen.call(f"{MACHINE}.Stop") == "BadUserAccessDenied"

    beyond.cell.asked.clear()
    beyond.look(watch, user="bob", certificate=known)
    assert beyond.cell.asked == []


def test_without_a_name_nobody_is_let_in(beyond: Site, known: Path) -> None:
    async def watch(seen: Seen) -> None:
        raise AssertionError("let in")

    with pytest.raises(ua.UaError):
        beyond.look(watch, certificate=known)
    with pytest.raises(ua.UaError):
        beyond.look(watch, user="nobody", certificate=known)


def test_without_encryption_nobody_is_let_in(beyond: Site) -> None:
    async def watch(seen: Seen) -> None:
        raise AssertionError("let in")

    for user in ("", "ada"):
        with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
            beyond.look(watch, user=user)


def test_endpoints_beyond_this_computer_are_all_encrypted(beyond: Site) -> None:
    offered = asyncio.run(
        Client(f"opc.tcp://127.0.0.1:{beyond.port}").connect_and_get_server_endpoints()
    )
    assert {e.SecurityMode for e in offered} == {ua.MessageSecurityMode.SignAndEncrypt}


def test_a_stranger_is_refused_until_a_person_trusts_its_certificate(
    beyond: Site, tmp_path: Path
) -> None:
    certificate, states = certificate_in(tmp_path), []

    async def watch(seen: Seen) -> None:
        states.append(await seen.read("Cell.State"))

    with pytest.raises(ua.UaError):
        beyond.look(watch, user="ada", certificate=certificate)
    shown = certificate.read_bytes()
    (kept,) = [p for p in (beyond.folder / "rejected").iterdir() if p.read_bytes() == shown]
    kept.rename(beyond.folder / "trusted" / kept.name)
    beyond.look(watch, user="ada", certificate=certificate)
    assert len(states) == 1


def test_no_password_and_no_key_can_be_read_by_others(beyond: Site) -> None:
    secret = [
        p for p in beyond.folder.rglob("*") if p.is_file() and p.name in ("key.pem", "users.yaml")
    ]
    assert secret
    for path in secret:
        assert path.stat().st_mode & 0o077 == 0, path
        assert PASSWORD.encode() not in path.read_bytes()
