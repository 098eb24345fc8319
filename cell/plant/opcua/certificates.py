"""Certificates: the server's own, made at its first start, and those of clients that it trusts."""

from __future__ import annotations

import hashlib
import logging
import socket
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from asyncua.crypto import cert_gen
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from cell.files.secret_file import write_secret

_LOG = logging.getLogger(__name__)

#: The server's certificate is valid for so long, days, and made again with so many left.
_DAYS, _LEFT_DAYS = 3650, 30
#: At most so many certificates of strangers are kept.
_STRANGERS = 20


def own_certificate(folder: Path, uri: str, listen: str) -> tuple[Path, Path]:
    """Files of the server's certificate and key; made if missing, too old or of another server.

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
        found = x509.load_der_x509_certificate(path.read_bytes())
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        return False
    uris = names.get_values_for_type(x509.UniformResourceIdentifier)
    return uri in uris and found.not_valid_after_utc > datetime.now(UTC) + timedelta(_LEFT_DAYS)


class TrustedClients:
    """Certificates of clients in two folders: `trusted`, and `rejected`, where strangers' are put.

    A person moves a file from one to the other; it counts from the next connection on.
    """

    def __init__(self, folder: Path) -> None:
        self.trusted, self.rejected = folder / "trusted", folder / "rejected"
        for made in (self.trusted, self.rejected):
            made.mkdir(parents=True, exist_ok=True)

    def knows(self, certificate: bytes) -> bool:
        """Whether a certificate, DER, is trusted and valid now; a stranger's is kept."""
        try:
            found = x509.load_der_x509_certificate(certificate)
        except ValueError:
            return False
        if not found.not_valid_before_utc <= datetime.now(UTC) <= found.not_valid_after_utc:
            return False
        if any(_der(path) == certificate for path in sorted(self.trusted.iterdir())):
            return True
        self._keep(certificate)
        return False

    def _keep(self, certificate: bytes) -> None:
        path = self.rejected / f"{hashlib.sha256(certificate).hexdigest()[:16]}.der"
        if path.exists() or len(list(self.rejected.iterdir())) >= _STRANGERS:
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
