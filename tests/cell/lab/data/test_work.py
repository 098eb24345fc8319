"""A budget of work: shared out by stage and by job, spent softly, then hard."""

from __future__ import annotations

import pickle
import time

import pytest

from cell.lab.data.work import (
    PARTS_OF_ONE,
    SOLVER,
    STAGES,
    Budget,
    SpentError,
    Work,
    WorkStoppedError,
    side_by_side,
)


def simulate(work: Work, seconds: float) -> None:
    work.add(1, seconds, SOLVER)


def test_each_stage_ends_by_its_share_and_leaves_what_it_does_not_use() -> None:
    work = Work(Budget(simulated_s=1000.0))
    for share in STAGES.values():
        assert share <= 1.0
    with work.stage("prepare"):
        simulate(work, 299.0)
        assert not work.spent
        simulate(work, 1.0)
        assert work.spent
    with work.stage("search"):
        assert not work.spent
        simulate(work, 250.0)
        assert not work.affords("a fit with air_drag")
    assert work.left_out == ["a fit with air_drag"]
    assert not work.spent, "without a stage all of it is there"


def test_beyond_a_slack_no_simulation_begins() -> None:
    work = Work(Budget(simulated_s=100.0))
    with work.stage("prepare"):
        simulate(work, 104.0)
        simulate(work, 10.0)
        with pytest.raises(SpentError):
            simulate(work, 1.0)
    work.conclude()
    simulate(work, 1.0)


def test_processor_time_is_the_outer_limit() -> None:
    """Simulations that fail count for little motion, and take long."""
    work = Work(Budget(cpu_s=0.05))
    while work.cpu_s < 0.06:
        pass
    assert work.spent
    with pytest.raises(SpentError):
        simulate(work, 1.0)


def test_whoever_stops_is_heard_once() -> None:
    work = Work(Budget(simulated_s=100.0), known="noise 0.1 mm")
    work.stop()
    with pytest.raises(WorkStoppedError, match="noise"):
        simulate(work, 1.0)
    work.conclude()
    work.stop()
    simulate(work, 1.0)
    assert work.spent, "nothing new is begun"


def test_a_budget_is_renewed_for_another_computation() -> None:
    work = Work(Budget(simulated_s=100.0))
    simulate(work, 101.0)
    work.conclude()
    work.renew()
    assert not work.spent
    simulate(work, 99.0)
    assert not work.spent


def test_in_another_process_the_processor_time_goes_on() -> None:
    work = Work(Budget(cpu_s=1e3))
    while work.cpu_s < 0.02:
        pass
    copy = pickle.loads(pickle.dumps(work))
    assert copy.cpu_s == pytest.approx(work.cpu_s, abs=0.02)
    assert copy.cpu_s >= 0.02


def test_each_job_has_the_same_share_whoever_does_it() -> None:
    """What is left out does not depend on the number of cores."""
    work = Work(Budget(simulated_s=800.0))

    def job(seconds: float) -> float:
        while seconds > 0.0 and not work.spent:
            simulate(work, 10.0)
            seconds -= 10.0
        return work.simulated_s

    jobs = [10.0, 1e6, 20.0, 1e6, 10.0, 10.0, 10.0, 10.0]
    with side_by_side(work, [job], (), len(jobs)) as beside:
        done = beside.map(job, jobs, lambda _: -1.0)
    share = PARTS_OF_ONE * 100.0
    assert done == [10.0, share, 20.0, share, 10.0, 10.0, 10.0, 10.0]
    assert work.simulated_s == sum(done)


def test_a_job_that_ends_nowhere_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cell.lab.data.work.threads", lambda: 1)
    work = Work(Budget(simulated_s=100.0))

    def job(seconds: float) -> str:
        for _ in range(int(seconds)):
            simulate(work, 1.0)
        return "done"

    with side_by_side(work, [job], (), 2) as beside:
        assert beside.map(job, [1.0, 1e6], lambda _: "left out") == ["done", "left out"]


def test_the_time_of_forks_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cell.lab.data.work.threads", lambda: 2)
    work = Work()

    def job(_: int) -> int:
        began_s = time.process_time()
        while time.process_time() < began_s + 0.03:
            pass
        return 1

    before_s = work.cpu_s
    with side_by_side(work, [job], (), 4) as beside:
        beside.map(job, range(4), lambda _: 0)
    assert work.cpu_s - before_s >= 4 * 0.03


def test_errors_of_fits_are_seen_as_they_come_and_kept_in_one_order():
    """Which fit ends first depends on the computer; a result must not."""
    seen = []
    work = Work(watcher=seen.append)
    for names, rms_m in ((("b", "a"), 3.0), ((), 9.0), (("b",), 5.0), (("a",), 7.0), (("b",), 4.0)):
        work.note_fit(names, rms_m, 1.0)
    assert [e.rms_m for e in seen] == [3.0, 9.0, 5.0, 7.0, 4.0]
    assert [e.effects for e in work.fit_errors] == [(), ("a",), ("b",), ("a", "b")]
    assert pickle.loads(pickle.dumps(work)).fit_errors == work.fit_errors  # for a worker
