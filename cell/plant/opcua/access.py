"""Access to the OPC UA server: sessions of clients, their users and roles.

asyncua alone would let a client in without encryption whatever endpoints are offered, and hand a
session over to whoever names it.  Both are closed here.
"""

from __future__ import annotations

import hashlib
import logging
import socket
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto import cert_gen
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from cell.files.atomic import write_secret
from cell.plant.users import Role
from cell.plant.users import Users as Accounts

#: Validity of the server's certificate, and remaining validity at which it is renewed, days.
_DAYS, _RENEWAL_DAYS = 3650, 30
#: Largest number of stored certificates of unknown clients.
_MOST_REJECTED = 20


def own_certificate(folder: Path, uri: str, listen: str) -> tuple[Path, Path]:
    """Files of the server's certificate and key; created if missing, expired or another server's.

    uri     of the application; clients find it in the certificate
    listen  address at which the server listens
    raises  OSError: they cannot be written
    """
    certificate, key = folder / "own" / "certificate.der", folder / "own" / "key.pem"
    if certificate.is_file() and key.is_file() and _fits(certificate, uri):
        return certificate, key
    private = cert_gen.generate_private_key()
    names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(uri)]
    names.append(x509.DNSName(socket.gethostname()))
    try:
        names.append(x509.IPAddress(ip_address(listen)))
    except ValueError:
        names.append(x509.DNSName(listen))
    made = cert_gen.generate_self_signed_app_certificate(
        private,
        "Cable cell",
        {"organizationName": "Cable cell"},
        names,
        extended=[ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH],
        days=_DAYS,
    )
    write_secret(key, cert_gen.dump_private_key_as_pem(private))
    write_secret(certificate, made.public_bytes(Encoding.DER))
    _LOG.info("made a certificate: %s", certificate)
    return certificate, key


def _fits(path: Path, uri: str) -> bool:
    try:
        parsed = x509.load_der_x509_certificate(path.read_bytes())
        names = parsed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        return False
    uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    return uri in uris and parsed.not_valid_after_utc > datetime.now(UTC) + timedelta(_RENEWAL_DAYS)


class TrustedClients:
    """Certificates of clients in two folders: `trusted`, and `rejected` for unknown ones.

    A person moves a file from one to the other; it counts from the next connection on.
    """

    def __init__(self, folder: Path) -> None:
        self.trusted, self.rejected = folder / "trusted", folder / "rejected"
        for made in (self.trusted, self.rejected):
            made.mkdir(parents=True, exist_ok=True)

    def knows(self, certificate: bytes) -> bool:
        """Whether a certificate, DER, is trusted and valid now; an unknown one is stored."""
        try:
            parsed = x509.load_der_x509_certificate(certificate)
        except ValueError:
            return False
        if not parsed.not_valid_before_utc <= datetime.now(UTC) <= parsed.not_valid_after_utc:
            return False
        if any(_der(path) == certificate for path in sorted(self.trusted.iterdir())):
            return True
        self._store_rejected(certificate)
        return False

    def _store_rejected(self, certificate: bytes) -> None:
        path = self.rejected / f"{hashlib.sha256(certificate).hexdigest()[:16]}.der"
        if path.exists() or len(list(self.rejected.iterdir())) >= _MOST_REJECTED:
            return
        try:
            path.write_bytes(certificate)
        except OSError as error:
            _LOG.warning("a stranger's certificate is not kept: %s", error)
            return
        _LOG.warning("a client is not trusted; move %s to %s to trust it", path, self.trusted)


def _der(path: Path) -> bytes | None:
    """The certificate in a file, DER or PEM; None = there is none in it."""
    try:
        content = path.read_bytes()
        if content.startswith(b"-----BEGIN"):
            return x509.load_pem_x509_certificate(content).public_bytes(Encoding.DER)
    except (OSError, ValueError):
        return None
    return content


_LOG = logging.getLogger(__name__)

#: Name of whoever calls the method under way.
caller: ContextVar[str] = ContextVar("caller", default="")

ANONYMOUS = "anonymous"
#: Timeout of silent sessions, s: messages waiting for a stalled client are dropped.
_SESSION_S = 60.0
#: So many notifications of one item wait for a client.
_WAITING = 1000
#: So many clients at a time.
_CLIENTS = 100


@dataclass
class OpcUaUser(User):  # type: ignore[misc]
    """User of a session.

    operates  whether it may give commands, now
    """

    operates: Callable[[], bool] = lambda: False


class OpcUaUsers:
    """Authenticates clients for asyncua, by the file of users."""

    def __init__(self, accounts: Accounts, anonymous: bool) -> None:
        self._accounts, self._anonymous = accounts, anonymous

    def get_user(
        self,
        iserver: InternalServer,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> User | None:
        """The user; None = refused."""
        if username is None:
            if not self._anonymous:
                return None
            return OpcUaUser(UserRole.User, ANONYMOUS, self._has_no_accounts)
        try:
            known = self._accounts.authenticate(username, password or "")
        except (ValueError, OSError) as error:
            _LOG.error("%s", error)
            return None
        if known is None:
            _LOG.warning("refused: user %r, or the password", username)
            return None
        operates = known.role >= Role.operate
        return OpcUaUser(UserRole.User, username, lambda: operates)

    def _has_no_accounts(self) -> bool:
        """Whether nobody has a name, so that who has none may command; no, if nobody can tell."""
        try:
            return len(self._accounts) == 0
        except (ValueError, OSError) as error:
            _LOG.error("%s", error)
            return False


class GuardedSession(InternalSession):  # type: ignore[misc]
    """Session of one client, which may have to present a trusted certificate."""

    trusted: TrustedClients | None = None

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Let a client in.  Raises ServiceError: not encrypted, or its certificate is unknown."""
        if self.trusted is not None:
            if not peer_certificate:  # a channel without encryption
                raise ServiceError(ua.StatusCodes.BadSecurityModeRejected)
            if not self.trusted.knows(peer_certificate):
                raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)
        return super().activate_session(params, peer_certificate)

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Call methods, if this user may."""
        if not isinstance(self.user, OpcUaUser) or not self.user.operates():
            denied = ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)
            return [ua.CallMethodResult(StatusCode=denied) for _ in params]
        token = caller.set(self.user.name or ANONYMOUS)
        try:
            results: list[ua.CallMethodResult] = await super().call(params)
            return results
        finally:
            caller.reset(token)

    async def history_read(self, params: ua.HistoryReadParameters) -> list[ua.HistoryReadResult]:
        """No node has a history: the ledger has it."""
        none = ua.StatusCode(ua.StatusCodes.BadHistoryOperationUnsupported)
        unknown = ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown)
        known = (node.NodeId in self.aspace for node in params.NodesToRead)
        return [ua.HistoryReadResult(StatusCode=none if k else unknown) for k in known]

    async def history_update(
        self, params: ua.HistoryUpdateParameters
    ) -> list[ua.HistoryUpdateResult]:
        """Nobody changes a history that no node has."""
        none = ua.StatusCode(ua.StatusCodes.BadHistoryOperationUnsupported)
        return [ua.HistoryUpdateResult(StatusCode=none) for _ in params.HistoryUpdateDetails]

    async def transfer_subscriptions(
        self, params: ua.TransferSubscriptionsParameters, callback: Callable[..., Any]
    ) -> list[ua.TransferResult]:
        """Nobody gets another session's subscriptions; raises ServiceError."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


class GuardedServer(InternalServer):  # type: ignore[misc]
    """Internal server of asyncua, with users, certificates and guarded sessions.

    accounts  who may come
    folder    of certificates
    open_     clients may come without encryption and without a name; once there are accounts, who
              has no name only watches
    """

    def __init__(self, accounts: Accounts, folder: Path, open_: bool) -> None:
        super().__init__(user_manager=OpcUaUsers(accounts, anonymous=open_))
        self._trusted = None if open_ else TrustedClients(folder)
        tokens = [ua.UserNameIdentityToken, *([ua.AnonymousIdentityToken] if open_ else [])]
        self.supported_tokens = tuple(tokens)
        self.allow_remote_admin = False
        self.max_session_timeout_ms = 1e3 * _SESSION_S
        self.max_monitored_item_queue_size = _WAITING
        self.max_connections = _CLIENTS

    def create_session(
        self, name: str, user: User | None = None, external: bool = False
    ) -> InternalSession:
        """A session; asyncua's own, which no client uses, stays as it is."""
        if not external:
            return super().create_session(name, user or User(), external)
        session = GuardedSession(
            self, self.aspace, self.subscription_service, name, user or User(), external
        )
        session.trusted = self._trusted
        return session

    def lookup_external_session(self, auth_token: ua.NodeId) -> InternalSession | None:
        """None: a client whose connection broke begins anew, as its name is checked only then."""
        return None

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Raises ServiceError: other servers are not listed here."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)
