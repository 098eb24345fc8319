"""Sessions of logged-in people, and the page that has control of the cell."""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from cell.plant.users import Role, User

#: Time without a request after which a session ends, and its longest duration, s.
IDLE_S, LONGEST_S = 30 * 60.0, 12 * 3600.0
#: Largest numbers of wrong passwords within `_LATELY_S`: of a name from one address, of all names
#: from one address, and in all.  The last limit exempts a name at an address with an earlier login.
MOST_WRONG, MOST_WRONG_OF_ADDRESS, MOST_WRONG_IN_ALL = 5, 20, 200
_LATELY_S = 60.0
#: Largest number of stored entries; the oldest are dropped first.
_MOST = 1000


@dataclass(frozen=True)
class LoginLimit:
    """A limit of wrong passwords that has been reached.

    counted   kind of the count
    is_first  whether this is its first refusal within the last minute
    """

    counted: str
    is_first: bool


@dataclass
class LoginSession:
    """Session of one logged-in person.

    key  identifier within the server; the cookie's token cannot be derived from it
    """

    user: User
    key: str
    started_s: float
    last_used_s: float


class Sessions:
    """All sessions; safe to be used from several threads.

    named  current user of a name in the accounts: a removed user has no session any more
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
        self._refused_s: dict[str, float] = {}
        self._proved: dict[tuple[str, str], None] = {}

    def begin(self, user: User) -> str:
        """Token of a new session, which is stored in its cookie only."""
        token, now = secrets.token_urlsafe(32), self._now_s()
        key = _key(token)
        with self._lock:
            while len(self._open) >= _MOST:
                self._open.pop(next(iter(self._open)))
            self._open[key] = LoginSession(user, key, now, now)
        return token

    def of(self, token: str | None) -> LoginSession | None:
        """Session of a cookie, counted as used; None = unknown, expired or ended."""
        return None if not token else self.renewed(_key(token))

    def renewed(self, key: str, *, used: bool = True) -> LoginSession | None:
        """Session of a key, with the current role of its user.

        used  whether a person has acted, in contrast to an open page
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
        """Log out: the token becomes invalid."""
        with self._lock:
            self._open.pop(_key(token or ""), None)

    def count_login(self, name: str, address: str) -> LoginLimit | None:
        """Count a password as wrong before it is checked; the limit that refuses the check.

        `count_right` reverts it, so that concurrent requests do not allow more attempts.
        """
        now = self._now_s()
        with self._lock:
            if len(self._wrong) > _MOST:
                self._wrong = {w: t for w, t in self._wrong.items() if now - t[-1] < _LATELY_S}
                self._refused_s = {w: t for w, t in self._refused_s.items() if now - t < _LATELY_S}
            limits = _limits(name, address)
            for counted, most in limits.items():
                lately = sum(now - t < _LATELY_S for t in self._wrong.get(counted, ()))
                spared = counted == _IN_ALL and (name, address) in self._proved
                if lately >= most and not spared:
                    is_first = now - self._refused_s.get(counted, -_LATELY_S) >= _LATELY_S
                    if is_first:
                        self._refused_s[counted] = now
                    return LoginLimit(counted, is_first)
            for counted in limits:
                times = self._wrong.get(counted, ())
                self._wrong[counted] = [*(t for t in times if now - t < _LATELY_S), now]
            return None

    def count_right(self, name: str, address: str) -> None:
        """Revert the count of a correct password."""
        with self._lock:
            for counted in _limits(name, address):
                times = self._wrong.get(counted, [])
                del times[-1:]
                if not times:
                    self._wrong.pop(counted, None)
            while len(self._proved) >= _MOST:
                self._proved.pop(next(iter(self._proved)))
            self._proved[name, address] = None


_IN_ALL = "in all"


def _limits(name: str, address: str) -> dict[str, int]:
    """Counters of a login, and their limits of wrong passwords."""
    return {
        f"of {name} from {address}": MOST_WRONG,
        f"from {address}": MOST_WRONG_OF_ADDRESS,
        _IN_ALL: MOST_WRONG_IN_ALL,
    }


def local_session() -> LoginSession:
    """Session of a person at this computer, without login: loopback has no accounts."""
    return LoginSession(User("local", Role.engineer), "", 0.0, 0.0)


def _key(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


#: Time without a sign of life after which a page loses control, s.
LOST_S = 30.0


@dataclass(frozen=True)
class Holder:
    """Holder of the control: the page, and the person's name."""

    page: str
    name: str


class Control:
    """The exclusive right to command the cell; Stop only needs the role of an operator."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._holder: Holder | None = None
        self._heard_s = 0.0

    def take(self, page: str, name: str) -> Holder:
        """Take control if it is free, or from another page of the same person; the new holder."""
        with self._lock:
            holder = self._present()
            if holder is None or holder.name == name:
                self._holder, self._heard_s = Holder(page, name), self._now_s()
            assert self._holder is not None
            return self._holder

    def release(self, page: str) -> None:
        """Release control; no effect if another page has it."""
        with self._lock:
            if self._holder is not None and self._holder.page == page:
                self._holder = None

    def keep_alive(self, page: str) -> Holder | None:
        """Register a sign of life of a page; the holder of the control, None = nobody."""
        with self._lock:
            holder = self._present()
            if holder is not None and holder.page == page:
                self._heard_s = self._now_s()
            return holder

    def _present(self) -> Holder | None:
        if self._now_s() - self._heard_s > LOST_S:
            self._holder = None
        return self._holder
