"""One suite for all executors: results are the same, bit for bit, wherever jobs are done."""

from __future__ import annotations

import os
from contextlib import closing

import pytest

from cell.cable.effects import load_effect
from cell.workers.executor import WorkersError
from cell.workers.here import LocalCores, OneAfterAnother, this_computer
from tests.cell.workers import jobs

PULL = """
from cell.cable.effects import Effect, Parameter


class Pull(Effect):
    name = "own_pull"
    parameters = (Parameter("mass_kg", "kg", 0.0, 1.0, 0.0, (5e-3,)),)

    def tip_mass(cable, p):
        return p.mass_kg
"""


def values(executor, function, given, **named):
    return [result.value for result in executor.map(function, given, **named)]


def test_results_are_those_of_this_process_in_the_order_of_the_jobs(executor):
    assert values(executor, jobs.square, range(20)) == [jobs.square(n) for n in range(20)]
    assert values(executor, jobs.square, []) == []


def test_an_error_is_the_result_of_its_job_and_the_others_are_done(executor):
    found = list(executor.map(jobs.odd_fails, range(5)))
    assert [f.number for f in found] == list(range(5))
    assert [f.value for f in found[::2]] == [0, 2, 4]
    assert str(found[3].error) == "of 3"
    with pytest.raises(ZeroDivisionError, match="of 1"):
        _ = found[1].value


def test_an_error_that_cannot_be_sent_arrives_as_its_text(executor):
    (found,) = executor.map(jobs.fails_specially, [7])
    assert "here:7" in str(found.error)


def test_what_a_job_changes_no_other_sees(executor):
    function = jobs.Counter()
    assert values(executor, function, range(6)) == [1] * 6
    assert function.calls == []


def test_what_cannot_be_sent_is_refused(executor):
    with pytest.raises(WorkersError, match=r"cannot be sent to a worker: .*lambda"):
        list(executor.map(lambda job: job, [1]))


def test_jobs_are_taken_a_few_ahead_of_the_results_only(executor):
    taken = []

    def endless():
        while True:
            taken.append(None)
            yield len(taken)

    with closing(executor.map(jobs.slowly, endless())) as results:
        assert next(results).value == 1
        assert next(results).value == 2
    assert len(taken) <= 12
    assert values(executor, jobs.square, [3]) == [jobs.square(3)]  # it can be used again


def test_whoever_waits_can_stop(executor):
    looks = []

    def check():
        looks.append(None)
        if len(looks) > 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        values(executor, jobs.slowly, range(1000), check=check)


def test_what_makes_the_jobs_may_fail(executor):
    def failing():
        yield 1
        raise OSError("no such folder")

    with pytest.raises(OSError, match="no such folder"):
        values(executor, jobs.square, failing())


def test_an_effect_of_a_users_file_goes_and_comes_back(executor, tmp_path):
    file = tmp_path / "own_pull.py"
    file.write_text(PULL)
    effect = load_effect(file)
    (found,) = values(executor, jobs.value_of, [effect])
    assert found[0] is effect
    assert found[1:] == ("own_pull", effect.file.sha256)


def test_an_effect_whose_file_was_changed_is_refused(executor, tmp_path):
    file = tmp_path / "own_pull.py"
    file.write_text(PULL)
    effect = load_effect(file)
    file.write_text(PULL + "# changed\n")
    with pytest.raises(WorkersError, match="was changed after it was read; run the command again"):
        values(executor, jobs.value_of, [effect])


def test_a_job_has_one_core(executor):
    """With another number of cores a fit has other last digits."""
    assert values(executor, jobs.cores, [0, 1]) == [1, 1]


def test_a_killed_copy_is_replaced_and_its_job_done_again(tmp_path):
    found = values(LocalCores(2), jobs.EndsOnce(tmp_path, 3), range(30))
    assert found == [jobs.square(n) for n in range(30)]
    assert (tmp_path / "killed").exists()
    assert len(list(tmp_path.iterdir())) == 4  # two, and the one that took a place
    assert str(os.getpid()) not in {p.name for p in tmp_path.iterdir()}


def test_a_job_that_ends_every_process_is_told_and_the_others_are_done():
    found = list(LocalCores(2).map(jobs.ends_always, range(4)))
    assert "ended its process 2 times" in str(found[1].error)
    assert [f.value for f in found if f.error is None] == [0, 2, 3]


def test_this_computer_is_what_its_system_permits(monkeypatch):
    assert this_computer(3).workers == 3
    monkeypatch.setattr("sys.platform", "darwin")
    assert isinstance(this_computer(3), OneAfterAnother)
