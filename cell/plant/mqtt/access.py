"""How the broker is reached: certificates and the password, from where the settings say."""

from __future__ import annotations

import os
import ssl
import stat

from cell.settings.plant.mqtt import Mqtt, MqttTls

#: Environment variable of the password.
PASSWORD = "CELL_MQTT_PASSWORD"


def password_of(settings: Mqtt) -> str | None:
    """The password; None = no user is named.

    raises  ValueError: there is none, or others may read it
    """
    if settings.user is None:
        return None
    if settings.password_file is None:
        if PASSWORD not in os.environ:
            raise ValueError(
                f"plant.mqtt.user: there is no password of {settings.user!r}; put it into the "
                f"environment variable {PASSWORD}, or name a password_file"
            )
        return os.environ[PASSWORD]
    path = settings.password_file
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"plant.mqtt.password_file: {path} cannot be read: {error}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ValueError(
            f"plant.mqtt.password_file: others may use {path} (mode {stat.S_IMODE(mode):o}); "
            f"`chmod 600 {path}`"
        )
    if not text.strip():
        raise ValueError(f"plant.mqtt.password_file: {path} is empty; write the password into it")
    return text.splitlines()[0]


def tls_of(settings: MqttTls | None) -> ssl.SSLContext | None:
    """Certificates that are trusted and shown.  Raises ValueError: a file is missing or is none."""
    if settings is None:
        return None
    try:
        context = ssl.create_default_context(cafile=settings.ca)
    except (OSError, ssl.SSLError) as error:
        raise ValueError(
            f"plant.mqtt.tls.ca: {settings.ca}: {error}; give a file of certificates, PEM"
        ) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if settings.certificate is not None:
        try:
            context.load_cert_chain(settings.certificate, settings.key, password=lambda: b"")
        except (OSError, ssl.SSLError) as error:
            raise ValueError(
                f"plant.mqtt.tls.certificate: {settings.certificate}: {error}; give a certificate "
                "and its key without a password, PEM"
            ) from error
    return context
