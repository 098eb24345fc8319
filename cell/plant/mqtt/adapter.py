"""Delivers the notices of the outbox to the broker: in order, one message at a time.

Each connection starts without state in broker or library.  A message stays in the outbox until
it is acknowledged, so nothing is lost, whichever program is killed.  After a loss it is sent
again, with the same run and sequence.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import ssl
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from cell.files.atomic import read_secret
from cell.plant.client import Client
from cell.plant.messages import Status
from cell.plant.mqtt.form import EndOfSessionError, Message, PayloadForm, PublishedState
from cell.plant.mqtt.outbox import MqttOutbox, OutboxError
from cell.plant.wire import LinkError
from cell.settings.plant import Mqtt, MqttTls
from drivers.threads import GuardedThread, error_text

if TYPE_CHECKING:
    import aiomqtt

_LOG = logging.getLogger(__name__)

#: Environment variable of the password.
PASSWORD = "CELL_MQTT_PASSWORD"
#: Pause after a failure of the disk, s.
_AGAIN_S = 1.0
#: Shortest pause before the broker is tried again, s; then twice as long, up to `retry_s`.
_FIRST_S = 0.1
#: Shortest interval between two statuses, s.
_STATUS_S = 0.5
#: Longest wait for an acknowledgement of the broker, s.
_ANSWER_S = 10.0


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
    return read_secret(settings.password_file, "plant.mqtt.password_file")


def tls_of(settings: MqttTls | None) -> ssl.SSLContext | None:
    """TLS context for the broker.  Raises ValueError: a certificate is missing or invalid."""
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


class OutboxFeeder:
    """Follows a cell, and puts its notices into the outbox, within a `with`.

    runs    folder of the cell's records
    outbox  where notices are put
    notify  called, from the thread, when there is something new
    """

    def __init__(self, runs: Path, outbox: MqttOutbox, notify: Callable[[], None]) -> None:
        self._client = Client(runs, on_lost=self._lost, on_there=self._reconnected)
        self._outbox = outbox
        self._notify = notify
        self._over = threading.Event()
        self._thread = GuardedThread("taker", self._run, self._died)
        self.is_cell = False
        self.error: LinkError | None = None

    def __enter__(self) -> OutboxFeeder:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._client.close()
        self._thread.join(5.0)

    def status(self) -> Status | None:
        """State of the cell now; None = it is not reached."""
        try:
            return self._client.status()
        except LinkError:
            return None

    def _lost(self) -> None:
        self.is_cell = False
        _LOG.warning("the cell is away: it is waited for")
        self._notify()

    def _reconnected(self) -> None:
        if not self.is_cell:
            self.is_cell = True
            self._notify()

    def _died(self, error: BaseException) -> None:
        """The adapter ends with this error, and is started again."""
        self.error = LinkError(error_text(error))
        self._notify()

    def _run(self) -> None:
        after, requested_run = self._outbox.newest(), ""
        while not self._over.is_set():
            try:
                for message in self._client.follow(after):
                    self._reconnected()
                    if not isinstance(message, Status):
                        self._outbox.put(message)
                        after = message.run, message.sequence
                        self._notify()
                    elif message.sequence == 0 or requested_run == message.run:
                        after = message.run, message.sequence
                        self._outbox.start_after(after)
                    else:  # request the earlier notices of this run that the cell still has
                        requested_run = message.run
                        after = requested_run, 0
                        break
            except OutboxError as error:
                _LOG.error("%s; tried again", error)
                after = self._outbox.newest() if after is None else after
                self._over.wait(_AGAIN_S)
            except LinkError as error:
                if not self._over.is_set():
                    self.error = error
                    self._notify()
                return


class MqttAdapter:
    """Reports one cell to one broker.

    client_id  of the connection
    runs       folder of the cell's records
    new_form   makes the form of messages of a new connection
    raises     ValueError: there is no password, or a certificate is missing or invalid
    """

    def __init__(
        self,
        settings: Mqtt,
        client_id: str,
        runs: Path,
        outbox: MqttOutbox,
        new_form: Callable[[], PayloadForm],
    ) -> None:
        self._settings = settings
        self._client_id = client_id
        self._password, self._tls = password_of(settings), tls_of(settings.tls)
        self._runs = runs
        self._outbox = outbox
        self._new_form = new_form
        self._news = asyncio.Event()
        self._over = asyncio.Event()
        self._birth_due = False
        self._status: Status | None = None
        self._warning = ""

    def end(self) -> None:
        """End `run` after a farewell; waiting messages stay stored.  From the loop's thread."""
        self._over.set()
        self._news.set()

    async def run(self) -> None:
        """Deliver until `end`.

        raises  LinkError: cell and adapter are of different versions
        """
        from aiomqtt import MqttError

        loop = asyncio.get_running_loop()
        pause_s = _FIRST_S

        def notify() -> None:
            loop.call_soon_threadsafe(self._news.set)

        with OutboxFeeder(self._runs, self._outbox, notify) as feeder:
            while not self._over.is_set():
                begun_s = loop.time()
                try:
                    await self._connect(feeder)
                except* (MqttError, EndOfSessionError) as errors:
                    self._warn_once(f"broker: {errors.exceptions[0]}")
                if loop.time() - begun_s > _ANSWER_S:
                    pause_s = _FIRST_S
                await _wait(self._over, pause_s)
                pause_s = min(2.0 * pause_s, self._settings.retry_s)

    async def _connect(self, feeder: OutboxFeeder) -> None:
        """One connection to the broker, until it is lost or the adapter ends."""
        import aiomqtt

        form = self._new_form()
        will = form.will()
        async with (
            aiomqtt.Client(
                self._settings.broker,
                self._settings.broker_port,
                username=self._settings.user,
                password=self._password,
                identifier=self._client_id,
                tls_context=self._tls,
                keepalive=self._settings.keep_alive_s,
                will=aiomqtt.Will(will.topic, will.payload, will.qos, will.retain),
                timeout=_ANSWER_S,
                clean_session=True,
                socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],
            ) as client,
            asyncio.TaskGroup() as tasks,
        ):
            hearing = tasks.create_task(self._receive(client, form))
            for topic in form.subscriptions:
                await client.subscribe(topic, qos=1)
            self._warn_once("broker: connected")
            await self._deliver(client, form, feeder)
            hearing.cancel()

    async def _receive(self, client: aiomqtt.Client, form: PayloadForm) -> None:
        """Take in subscribed messages; raises MqttError as soon as the broker is lost."""
        async for message in client.messages:
            payload = message.payload if isinstance(message.payload, bytes) else b""
            if not message.retain or message.topic.value != form.subscriptions[0]:
                self._birth_due |= form.receive(message.topic.value, payload)
            self._news.set()

    async def _deliver(
        self, client: aiomqtt.Client, form: PayloadForm, feeder: OutboxFeeder
    ) -> None:
        self._news.clear()
        while not form.can_publish() and not self._over.is_set():
            await _wait(self._news)
            self._news.clear()
        self._birth_due, reached, sent_s, is_current = True, False, 0.0, True
        while not self._over.is_set():
            self._news.clear()
            if feeder.error is not None:
                raise feeder.error
            if self._birth_due or feeder.is_cell != reached:
                self._birth_due = False
                known = await self._published_state(feeder)
                reached = known.is_cell
                await self._send(client, form, form.birth(known))
            waiting = self._outbox.first()
            if waiting is not None:
                await self._send(client, form, form.of_notice(waiting.notice))
                self._outbox.remove(waiting)
                is_current = False
            elif not is_current and time.monotonic() - sent_s >= _STATUS_S:
                sent_s, known = time.monotonic(), await self._published_state(feeder)
                if is_current := self._is_up_to_date(known):
                    await self._send(client, form, form.of_status(known))
            else:
                await _wait(self._news, None if is_current else _STATUS_S)
        await self._send(client, form, form.farewell(await self._published_state(feeder)))

    async def _send(
        self, client: aiomqtt.Client, form: PayloadForm, messages: Sequence[Message]
    ) -> None:
        """Publish messages; returns when the broker has all of them."""
        for message in messages:
            await client.publish(message.topic, message.payload, message.qos, message.retain)
        if any(message.qos == 0 for message in messages):
            # the broker answers in order: it has the messages sent before
            await client.subscribe(form.subscriptions[0], qos=1)

    async def _published_state(self, feeder: OutboxFeeder) -> PublishedState:
        if (status := await asyncio.to_thread(feeder.status)) is not None:
            self._status = status
        return PublishedState(self._status, feeder.is_cell, self._outbox.dropped(), time.time())

    def _is_up_to_date(self, known: PublishedState) -> bool:
        """Whether the outbox has had every notice that the status contains."""
        if known.status is None or not known.is_cell:
            return True
        run, sequence = self._outbox.newest() or ("", 0)
        return run == known.status.run and sequence >= known.status.sequence

    def _warn_once(self, warning: str) -> None:
        if warning != self._warning:
            self._warning = warning
            _LOG.warning("%s; %d messages wait", warning, self._outbox.count())


async def _wait(event: asyncio.Event, most_s: float | None = None) -> None:
    """Wait for an event, for `most_s` at most."""
    with suppress(TimeoutError):
        async with asyncio.timeout(most_s):
            await event.wait()
