"""What the settings say of records: what is recorded of a cycle, and where cycles are listed."""

from __future__ import annotations

import itertools
import re
import reprlib
from datetime import time
from pathlib import Path
from typing import Annotated, Literal, get_args
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from cell.settings.section import NotNegative, Positive, Section


def database_url(url: str) -> str:
    """Validate a ledger's URL, without password, and return it.  Raises ValueError."""
    parts = urlsplit(url)
    kind = parts.scheme.split("+")[0]
    if kind not in ("sqlite", "postgresql"):
        raise ValueError(
            f"{url!r} is no URL of a ledger; give postgresql://user@host/name or sqlite:///file"
        )
    if parts.password is not None:
        raise ValueError(
            "has a password, which would be copied to every record; leave it out, and put it into "
            "~/.pgpass or the environment (PGPASSWORD)"
        )
    return url


def store_url(url: str) -> str:
    """Validate the URL of a store, without secrets, and return it.  Raises ValueError."""
    from fsspec.registry import known_implementations, registry

    parts = urlsplit(url)
    if not parts.scheme:
        if not Path(url).is_absolute():
            raise ValueError(f"{url!r} is no store; give a whole path, or s3://bucket/folder")
        return url
    if parts.scheme not in {*known_implementations, *registry}:
        raise ValueError(f"{parts.scheme}:// is no store that fsspec knows; s3://bucket/folder is")
    if parts.password is not None or parts.query:
        raise ValueError(
            "has a password or options, which would be copied to every record; put them into the "
            "environment (AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL, FSSPEC_...)"
        )
    return url


def times_of_day(times: tuple[str, ...]) -> tuple[str, ...]:
    """Validate times HH:MM in increasing order, and return them.  Raises ValueError."""
    if not times:
        raise ValueError("give at least one time, such as 00:00")
    for text in times:
        if re.fullmatch(r"([01]\d|2[0-3]):[0-5]\d(:[0-5]\d)?", text) is None:
            raise ValueError(f"{reprlib.repr(text)} is no time of a day; write it as '06:00'")
    parsed = [time.fromisoformat(t) for t in times]
    if any(a >= b for a, b in itertools.pairwise(parsed)):
        raise ValueError(f"{', '.join(times)} are not in order; give every time of a day once")
    return times


Ending = Literal["inserted", "missed", "rejected", "failed", "measured", "rehearsed", "unfit"]
ENDINGS: tuple[Ending, ...] = get_args(Ending)


class RecordingSettings(Section):
    """What is recorded of every cycle, frame by frame, and how long it is kept.

    A file named `keep` in a cycle's folder keeps its recording, whatever the limits."""

    keep: tuple[Ending, ...] = ENDINGS
    """Outcomes whose recordings are kept; the others are removed at once."""
    keep_every: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Recordings of every n-th cycle are kept whatever the outcome; 0 = none."""
    whole_frames: bool = False
    """Keep whole frames, 450 MB a cycle. If false, frames of inserted cables are reduced to what
    vision reads, 20 MB a cycle; other cycles keep whole frames while there is room."""
    memory_mb: Annotated[int, Field(ge=16, le=16_384)] = 512
    """Memory for frames that wait to be written. Further frames are dropped, and the gap is
    marked."""
    max_age_days: Positive | None = None
    """Age after which recordings are removed. Null = never."""
    max_size_gb: Positive | None = 20.0
    """Largest size of all recordings. Beyond it whole frames are reduced first, then the oldest
    recordings are removed. Null = no limit."""
    min_free_gb: NotNegative = 1.0
    """Free disk space required before a cycle. With less, the oldest recordings are removed; if
    that is not enough, nothing is recorded. 1 GB = 10⁹ bytes."""
    last_removed_every: Annotated[int, Field(ge=0, le=1_000_000)] = 100
    """Recordings of every n-th cycle are removed last, as are those of cables that were not
    inserted and of the first cycle of a shift; 0 = none."""
    store: Annotated[str, AfterValidator(store_url)] | None = None
    """Folder or object store (`/mnt/nas/line3`, `s3://bucket/line3`) for recordings. They are
    copied while no cable is gripped, verified, then removed here. Passwords come from the
    environment. Null = they stay in their folders."""


class LedgerSettings(Section):
    """Database of all cycles: outcomes, cables' parameters, faults."""

    url: Annotated[str, AfterValidator(database_url)] | None = None
    """`postgresql://user@host/name`: one server for the lines of a plant; its password is taken
    from the environment (PGPASSWORD) or from `~/.pgpass`.  Null = a file beside the folder of the
    records, `runs.sqlite`."""
    line: Annotated[str, Field(min_length=1, max_length=100)] | None = None
    """The line that this cell belongs to.  Null = the computer's name."""
    shifts: Annotated[tuple[str, ...], AfterValidator(times_of_day)] = ("06:00", "14:00", "22:00")
    """Local times at which shifts begin."""
    ideal_cycle_s: Positive | None = None
    """Ideal cycle time of one cable, for OEE's performance. Null = that of the fastest 10 % of the
    insertions."""
