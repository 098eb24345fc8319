"""Sessions of people who have logged in, and which of their pages has control of the cell."""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from cell.plant.users import Role, User

#: A session ends after so long without a request, and after so long in any case, s.
IDLE_S, LONGEST_S = 30 * 60.0, 12 * 3600.0
#: After so many wrong passwords for a name or from an address within `_LATELY_S`, it must wait.
MOST_WRONG = 5
_LATELY_S = 60.0
#: More are forgotten, the oldest first.
_MOST = 1000


@dataclass
class LoginSession:
    """One person's time at the pages.

    key  what it is known by here; no cookie can be made of it
    """

    user: User
    key: str
    started_s: float
    last_used_s: float


class Sessions:
    """All sessions; safe to be used from several threads.

    named  user of a name as the accounts say now: one who was removed has no session any more
    """

    def __init__(
        self,
        named: Callable[[str], User | None],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._named = named
        self._now_s = now_s
        self._lock = threading.Lock()
        self._open: dict[str, LoginSession] = {}
        self._wrong: dict[str, list[float]] = {}

    def begin(self, user: User) -> str:
        """Token of a new session, which only its cookie has."""
        token, now = secrets.token_urlsafe(32), self._now_s()
        key = _key(token)
        with self._lock:
            while len(self._open) >= _MOST:
                self._open.pop(next(iter(self._open)))
            self._open[key] = LoginSession(user, key, now, now)
        return token

    def of(self, token: str | None) -> LoginSession | None:
        """Session of a cookie, which is used now; None = unknown, expired or ended."""
        return None if not token else self.renewed(_key(token))

    def renewed(self, key: str, *, used: bool = True) -> LoginSession | None:
        """Session of a key, with the role that its user has now.

        used  whether a person has done something, not only a page that is open
        """
        now = self._now_s()
        with self._lock:
            session = self._open.get(key)
            if session is None:
                return None
            user = self._named(session.user.name)
            late = now - session.last_used_s > IDLE_S or now - session.started_s > LONGEST_S
            if late or user is None:
                del self._open[key]
                return None
            session.user = user
            if used:
                session.last_used_s = now
            return session

    def end(self, token: str | None) -> None:
        """Log out: the token is worth nothing any more."""
        with self._lock:
            self._open.pop(_key(token or ""), None)

    def login_allowed(self, *keys: str) -> bool:
        """Whether a password may be looked at: not too many were wrong lately.

        It counts as wrong for this name and from this address until `right` is told, so that many
        requests at once are no more tries than one after another.
        """
        now = self._now_s()
        with self._lock:
            if len(self._wrong) > _MOST:
                self._wrong = {w: t for w, t in self._wrong.items() if now - t[-1] < _LATELY_S}
            lately = [sum(now - t < _LATELY_S for t in self._wrong.get(w, ())) for w in keys]
            if any(number >= MOST_WRONG for number in lately):
                return False
            for who in keys:
                self._wrong.setdefault(who, []).append(now)
            return True

    def right(self, *keys: str) -> None:
        """A password was right: its try counts no more."""
        with self._lock:
            for who in keys:
                times = self._wrong.get(who, [])
                del times[-1:]
                if not times:
                    self._wrong.pop(who, None)


def local_session() -> LoginSession:
    """Session of whoever sits at this computer: on loopback there are no accounts."""
    return LoginSession(User("local", Role.engineer), "", 0.0, 0.0)


def _key(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


#: A page that has not been heard of for so long has control no more, s.
LOST_S = 30.0


@dataclass(frozen=True)
class Holder:
    """Whoever has control: the page, and the person's name."""

    page: str
    name: str


class Control:
    """The right to command the cell; Stop is everybody's who may operate."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._holder: Holder | None = None
        self._heard_s = 0.0

    def take(self, page: str, name: str) -> Holder:
        """Take control if it is free, or from another page of one's own; whoever has it then."""
        with self._lock:
            holder = self._present()
            if holder is None or holder.name == name:
                self._holder, self._heard_s = Holder(page, name), self._now_s()
            assert self._holder is not None
            return self._holder

    def release(self, page: str) -> None:
        """Give control back; nothing happens if somebody else has it."""
        with self._lock:
            if self._holder is not None and self._holder.page == page:
                self._holder = None

    def keep_alive(self, page: str) -> Holder | None:
        """A page is still there; who has control, None = nobody."""
        with self._lock:
            holder = self._present()
            if holder is not None and holder.page == page:
                self._heard_s = self._now_s()
            return holder

    def _present(self) -> Holder | None:
        if self._now_s() - self._heard_s > LOST_S:
            self._holder = None
        return self._holder
