"""Settings → where the evidence of cycles goes: the recorder, and the ledger."""

from __future__ import annotations

from functools import partial
from importlib.metadata import version
from pathlib import Path

from cell.records.ledger.outbox import LaterLedger, LedgerWriter, outbox_of
from cell.records.recording.devices import recorded_devices
from cell.records.recording.recorder import Recorder
from cell.records.recording.retention import DiskRoom, Retention
from cell.records.recording.store import Store
from cell.records.recording.uploads import Uploads
from cell.records.result import Outcome
from cell.run.archive import Keeping, LedgerSetup, RecordingSetup
from cell.settings import Settings
from cell.settings import devices as given
from cell.settings.referred import line_of
from drivers.interfaces import Devices

#: In simulated time a frame waits so long, s, for the recorder: nothing else is late by that.
PATIENCE_S = 60.0


def listed(settings: Settings, runs: Path) -> LedgerSetup | None:
    """The ledger that the settings name, and what it is told of this cell; None = there is none."""
    wanted = settings.ledger
    if wanted is None:
        return None
    writer = LedgerWriter(LaterLedger(wanted.url or runs), outbox_of(runs))
    writer.start()
    return LedgerSetup(writer, line_of(settings), software=version("cable-cell"))


def in_real_time(settings: Settings) -> bool:
    """Whether time passes in the cell as it does outside: what is late there is late."""
    simulated = isinstance(settings.arm, given.SimulatedArm)
    return not simulated or settings.world.real_time_factor is not None


def with_recorder(
    settings: Settings, devices: Devices, runs: Path
) -> tuple[Devices, RecordingSetup | None]:
    """Devices that are recorded, and how cycles are, as the settings say; None = not at all."""
    wanted = settings.recording
    if wanted is None:
        return devices, None
    patience_s = 0.0 if in_real_time(settings) else PATIENCE_S
    recorder = Recorder(devices.arm, devices.clock, wanted.memory_mb * 10**6, patience_s)
    days, size_gb = wanted.max_age_days, wanted.max_size_gb
    room = DiskRoom(
        None if days is None else days * 86_400.0,
        None if size_gb is None else size_gb * 1e9,
        wanted.min_free_gb * 1e9,
    )
    recording = RecordingSetup(
        recorder,
        keeping=Keeping(frozenset(map(Outcome, wanted.keep)), wanted.keep_every),
        retention=Retention(runs, room, only_stored=wanted.store is not None),
        uploads=None if wanted.store is None else _uploads(settings, wanted.store, runs),
    )
    return recorded_devices(devices, recorder, recording.uploads), recording


def _uploads(settings: Settings, url: str, runs: Path) -> Uploads:
    uploads = Uploads(partial(Store, url), runs, line_of(settings))
    uploads.start()
    return uploads
