"""Who is let in, and what they may do."""

from __future__ import annotations

import asyncio
import stat
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from cryptography.x509.oid import ExtendedKeyUsageOID

from cell.plant.users import Role, Users
from cell.settings.plant import OpcUa

from .conftest import PASSWORD, Seen, Site

STOP = "BaseStateMachine.MachineState.Stop"


@pytest.fixture
def stranger(tmp_path: Path) -> Path:
    """Certificate of a client that nobody trusts yet."""
    path = tmp_path / "client.der"
    use = [ExtendedKeyUsageOID.CLIENT_AUTH]
    made = setup_self_signed_certificate(
        path.with_suffix(".pem"), path, "urn:test:client", "localhost", use, {}
    )
    asyncio.run(made)
    return path


@pytest.fixture
def trusted(beyond: Site, stranger: Path) -> Path:
    """The same, trusted by the server that listens beyond this computer."""
    (beyond.folder / "trusted" / f"{stranger.parent.name}.der").write_bytes(stranger.read_bytes())
    return stranger


async def nothing(seen: Seen) -> None:
    raise AssertionError("was let in")


def test_only_loopback_addresses_are_open() -> None:
    for listen, open_ in (
        *(("127.0.0.1", True), ("127.0.1.7", True), ("::1", True), ("localhost", True)),
        *(("0.0.0.0", False), ("192.168.3.10", False), ("cell7", False), ("::", False)),
    ):
        assert OpcUa(listen=listen).is_loopback is open_


@asynccontextmanager
async def plain_channel(site: Site) -> AsyncIterator[Client]:
    """A client that does not care for the endpoints that a server offers."""
    client = Client(f"opc.tcp://127.0.0.1:{site.port}")
    await client.connect_socket()
    try:
        await client.send_hello()
        await client.open_secure_channel()
        yield client
    finally:
        client.disconnect_socket()


def test_without_encryption_nobody_is_let_in_beyond_loopback(beyond: Site) -> None:
    with pytest.raises(ua.UaError, match="No matching endpoints"):
        beyond.look(nothing)

    async def force() -> None:
        name = ua.UserNameIdentityToken(PolicyId="username", UserName="ada")
        name.Password = PASSWORD.encode()
        for token in (name, ua.AnonymousIdentityToken(PolicyId="anonymous")):
            async with plain_channel(beyond) as client:
                await client.uaclient.create_session(ua.CreateSessionParameters())
                parameters = ua.ActivateSessionParameters(UserIdentityToken=token)
                with pytest.raises(ua.UaStatusCodeError, match="BadSecurityModeRejected"):
                    await client.uaclient.activate_session(parameters)

    asyncio.run(force())


def test_without_a_name_nobody_is_let_in_beyond_loopback(beyond: Site, trusted: Path) -> None:
    with pytest.raises((ua.UaError, ua.UaStatusCodeError)):
        beyond.look(nothing, certificate=trusted)


def test_endpoints_beyond_loopback_encrypt_and_ask_for_a_name(beyond: Site) -> None:
    async def ask() -> list[ua.EndpointDescription]:
        client = Client(f"opc.tcp://127.0.0.1:{beyond.port}")
        return list(await client.connect_and_get_server_endpoints())

    endpoints = asyncio.run(ask())
    assert {e.SecurityMode for e in endpoints} == {ua.MessageSecurityMode.SignAndEncrypt}
    assert any(e.SecurityPolicyUri.endswith("#Basic256Sha256") for e in endpoints)
    tokens = {t.TokenType for e in endpoints for t in e.UserIdentityTokens}
    assert tokens == {ua.UserTokenType.UserName}


def test_a_stranger_is_refused_until_somebody_trusts_its_certificate(
    beyond: Site, stranger: Path
) -> None:
    with pytest.raises(ua.UaStatusCodeError, match="BadCertificateUntrusted"):
        beyond.look(nothing, user="ada", certificate=stranger)
    [kept] = [
        p for p in (beyond.folder / "rejected").iterdir() if p.read_bytes() == stranger.read_bytes()
    ]
    kept.rename(beyond.folder / "trusted" / kept.name)

    async def look(seen: Seen) -> None:
        await seen.until("Cell.State", "stopped")
        assert await seen.call(STOP) == "BadInvalidState"  # asked, and refused by the cell

    beyond.look(look, user="ada", certificate=stranger)
    assert beyond.cell.asked[-1].by == "opcua:ada"


def test_a_wrong_password_and_an_unknown_user_are_refused(beyond: Site, trusted: Path) -> None:
    for user in ("eve", "ada\0"):
        with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
            beyond.look(nothing, user=user, certificate=trusted)


def test_who_watches_sees_everything_and_commands_nothing(beyond: Site, trusted: Path) -> None:
    asked = len(beyond.cell.asked)

    async def look(seen: Seen) -> None:
        await seen.until("Cell.State", "stopped")
        assert await seen.call(STOP) == "BadUserAccessDenied"
        assert await seen.call("Cell.Start", "A-1", "long") == "BadUserAccessDenied"

    beyond.look(look, user="bob", certificate=trusted)
    assert len(beyond.cell.asked) == asked


def test_a_session_is_not_taken_over_by_its_token(beyond: Site, trusted: Path) -> None:
    """asyncua hands it over before it looks at name and password."""

    async def look(seen: Seen) -> None:
        token = seen.client.uaclient.protocol.authentication_token
        async with plain_channel(beyond) as thief:
            thief.uaclient.protocol.authentication_token = token
            with pytest.raises(ua.UaStatusCodeError):
                await thief.uaclient.activate_session(ua.ActivateSessionParameters())
            with pytest.raises(ua.UaStatusCodeError):
                await thief.get_node(ua.ObjectIds.Server_NamespaceArray).read_value()

    beyond.look(look, user="ada", certificate=trusted)


def test_once_there_are_users_nobody_without_a_name_commands(loopback: Site) -> None:
    users = Users(loopback.folder / "users.json")

    async def look(seen: Seen) -> None:
        assert await seen.call(STOP) != "BadUserAccessDenied"
        users.add("ada", Role.operate, PASSWORD)
        asked = len(loopback.cell.asked)
        for command in (STOP, "BaseStateMachine.Abort"):
            assert await seen.call(command) == "BadUserAccessDenied"
        assert len(loopback.cell.asked) == asked
        await seen.read("Cell.State")

    try:
        loopback.look(look)
    finally:
        users.remove("ada")


def test_secrets_are_readable_by_their_owner_only_and_no_password_is_kept(beyond: Site) -> None:
    for name in ("own/key.pem", "users.json"):
        assert stat.S_IMODE((beyond.folder / name).stat().st_mode) == 0o600
    text = (beyond.folder / "users.json").read_text(encoding="utf-8")
    assert PASSWORD not in text
    assert "$argon2id$" in text
