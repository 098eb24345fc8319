"""What asking the ledger costs with few cycles in it, and with many.

Every question of `cell history`, and what a run adds at its end: writing two entries, charts, and
the check of a promoted model.

    python -m tools.bench.bench_ledger --cycles 1000 100000 [--url postgresql://cell@host/empty]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from datetime import time as time_of_day
from pathlib import Path

import numpy as np

from cell.records.changed_model import worsenings
from cell.records.chart import signals
from cell.records.ledger.effectiveness import shifts
from cell.records.ledger.entry import LedgerEntry, LedgerEstimate
from cell.records.ledger.export import rows_of
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.result import Fault, Outcome, Result

LINE, CYCLE_S = "line3", 30.0
BEGUN = datetime(2026, 9, 1, tzinfo=UTC)
OUTCOMES = (Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED, Outcome.FAILED)
_TOGETHER = 1000


def entries(count: int) -> Iterator[LedgerEntry]:
    """Cycles one after another on three lines, as a plant makes them."""
    rng = np.random.default_rng(1)
    for n in range(count):
        outcome = OUTCOMES[int(rng.choice(4, p=(0.95, 0.02, 0.02, 0.01)))]
        fault = Fault("lower", f"cause {n % 7}", "arm", code=f"arm.{'limit' if n % 2 else 'lost'}")
        miss_m, ei = rng.normal(0.0, 1e-4, 2), 2e-5 * np.exp(rng.normal(0.0, 0.2, 6))
        estimates = [
            LedgerEstimate(f"rigidity_{k}", float(v), 1e-5, 4e-5) for k, v in enumerate(ei)
        ]
        estimates += [
            LedgerEstimate("exponent", 1.0, 0.9, 1.1),
            LedgerEstimate("viscosity", 1e-7, 9e-8, 2e-7),
        ]
        result = Result(
            n,
            outcome,
            f"/records/{n:08d}",
            offset_m=0.02,
            predicted_miss_m=float(miss_m[0]),
            measured_miss_m=float(miss_m[1]),
            predicted_std_m=1.4e-4,
            residual_rms_m=2e-5,
            noise_m=1e-5,
            model="0a1b2c" if n < count - 20 else "3d4e5f",
            seconds={f"step {k}": 1.0 for k in range(15)},
            state_seconds={"execute": 20.0 + float(rng.uniform(0.0, 5.0)), "completing": 2.0},
            fault=fault if outcome is Outcome.FAILED else None,
        )
        started = BEGUN + timedelta(seconds=CYCLE_S * n)
        yield LedgerEntry(
            line=LINE if n % 3 == 0 else f"line{n % 3}",
            cycle=n,
            folder=Path(result.folder),
            started=started,
            aim="inserted",
            part=f"P{n // 2:08d}",
            ended=started + timedelta(seconds=25.0),
            result=result,
            estimates=tuple(estimates),
        )


def filled(place: str | Path, count: int) -> Ledger:
    """A ledger with so many cycles."""
    ledger = Ledger(place, create=True)
    batch: list[LedgerEntry] = []
    for entry in entries(count):
        batch.append(entry)
        if len(batch) == _TOGETHER:
            ledger.write(batch)
            batch = []
    ledger.write(batch)
    return ledger


def questions(ledger: Ledger, count: int) -> dict[str, Callable[[], object]]:
    """What is asked, by name."""
    last = BEGUN + timedelta(seconds=CYCLE_S * count)
    week = LedgerQuery(since=last - timedelta(days=7))
    begins = [time_of_day(6), time_of_day(14), time_of_day(22)]
    new = iter(entries(10**9))

    def write() -> None:
        entry = next(new)
        folder = Path(f"/new/{time.time_ns()}")
        values = vars(entry) | {"folder": folder, "started": last}
        ledger.write([LedgerEntry(**(values | {"result": None, "estimates": ()}))])
        ledger.write([LedgerEntry(**values)])

    def end_of_run() -> None:
        results = ledger.results(LINE)
        signals([r for r in results if r.model == results[-1].model])
        worsenings(results)

    def exported() -> None:
        rows_of(ledger.listed(week, 1000, estimates=True))

    return {
        "newest 20": lambda: (ledger.listed(LedgerQuery(), 20), ledger.count(LedgerQuery())),
        "newest 20 of a line": lambda: (
            ledger.listed(LedgerQuery(line=LINE), 20),
            ledger.count(LedgerQuery(line=LINE)),
        ),
        "missed": lambda: (
            ledger.listed(LedgerQuery(outcomes=("missed",)), 20),
            ledger.count(LedgerQuery(outcomes=("missed",))),
        ),
        "one part": lambda: (
            ledger.listed(LedgerQuery(part="P00000100"), 20),
            ledger.count(LedgerQuery(part="P00000100")),
        ),
        "one fault": lambda: (
            ledger.listed(LedgerQuery(fault="arm.limit"), 20),
            ledger.count(LedgerQuery(fault="arm.limit")),
        ),
        "one model": lambda: (
            ledger.listed(LedgerQuery(model="3d4e5f"), 20),
            ledger.count(LedgerQuery(model="3d4e5f")),
        ),
        "faults by code": lambda: ledger.faults(LedgerQuery()),
        "OEE of a week": lambda: shifts(ledger, week, begins, last),
        "OEE of all": lambda: shifts(ledger, LedgerQuery(), begins, last),
        "1000 cycles with parameters": exported,
        "write a cycle": write,
        "end of a run: charts, promoted model": end_of_run,
    }


def best_ms(act: Callable[[], object], repeats: int = 7) -> float:
    """Least time of a few, ms."""
    times = []
    for _ in range(repeats):
        begun_s = time.perf_counter()
        act()
        times.append(time.perf_counter() - begun_s)
    return 1e3 * min(times)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table of times and of their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, nargs=2, default=(1000, 100_000))
    parser.add_argument("--url", nargs=2, help="two empty databases; default: SQLite files")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        places = given.url or [Path(folder) / str(n) for n in given.cycles]
        ledgers = [filled(p, n) for p, n in zip(places, given.cycles, strict=True)]
        asked = [questions(x, n) for x, n in zip(ledgers, given.cycles, strict=True)]
        print(f"{'milliseconds with so many cycles':40}", *(f"{n:>10}" for n in given.cycles))
        for name in asked[0]:
            few, many = (best_ms(q[name]) for q in asked)
            print(f"{name:40} {few:10.1f} {many:10.1f}   ratio {many / few:.1f}")
        for ledger in ledgers:
            ledger.close()


if __name__ == "__main__":
    main()
