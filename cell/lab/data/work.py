"""The lab's solver, and the work of simulations: counted, and limited by a budget."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from cell.cable.effects.base import Effect
from cell.cable.solver import Solver, threads
from cell.computer.compiling import computing_s
from cell.computer.forks import Forks, forks


class Progress(Protocol):
    """Callback for progress: `done` of `total` jobs are finished; 0 of 0 = not counted.

    It may be called from any thread.
    """

    def __call__(self, text: str, done: int = 0, total: int = 0) -> None:
        """Must return at once."""


def no_progress(text: str, done: int = 0, total: int = 0) -> None:
    """A `Progress` that shows nothing."""


@dataclass(frozen=True)
class ModelError:
    """Error of a fitted model: rms over the fit trials, per coordinate, and the noise, m.

    effects  in the model, sorted; () = the baseline
    """

    effects: tuple[str, ...]
    rms_m: float
    noise_m: float


def _unwatched(_: ModelError) -> None:
    """A watcher that ignores all fits."""


#: Within 4 µm (rms over the markers of a swing) of a converged cable.
SOLVER = Solver(segments=32, step_s=1e-3)

#: Stages of a diagnosis, and the share of its budget by which each has ended.  Unused budget is
#: available to the next stage.
STAGES = {
    "prepare": 0.3,
    "search": 0.55,
    "repeated search": 0.78,
    "conclude": 0.9,
    "strength": 0.97,
    "compare": 1.0,
}
#: Tolerance beyond the limit, as share of the budget, within which a simulation still begins: fits
#: complete their current iteration.
SLACK = 0.05


@dataclass(frozen=True)
class Budget:
    """The most work of a computation.

    simulated_s  seconds of cable motion, as `Work` counts them: a limit that is the same on every
                 computer
    cpu_s        of this process and its forks: the outer limit, for failing simulations and slow
                 computers
    """

    simulated_s: float = float("inf")
    cpu_s: float = float("inf")

    def share(self, share: float) -> Budget:
        """A share of it."""
        return Budget(share * self.simulated_s, share * self.cpu_s)

    def plus(self, other: Budget) -> Budget:
        """The sum of both."""
        return Budget(self.simulated_s + other.simulated_s, self.cpu_s + other.cpu_s)

    def minus(self, other: Budget) -> Budget:
        """The difference, at least 0."""
        difference = self.simulated_s - other.simulated_s, self.cpu_s - other.cpu_s
        return Budget(*(max(0.0, part) for part in difference))

    def exceeds(self, other: Budget) -> bool:
        """Whether it is at least as large in either component."""
        return self.simulated_s >= other.simulated_s or self.cpu_s >= other.cpu_s


NONE, UNLIMITED = Budget(0.0, 0.0), Budget()
#: Budget of a complete diagnosis: less than 60 s of one core.  The CPU time is the limit where a
#: second of motion costs most; with half the motion, rigs with two missing effects were cut short
#: and `unexplained`.
DIAGNOSIS = Budget(simulated_s=130_000.0, cpu_s=54.0)
#: Budget of the search for a law among many terms.
DISCOVERY = Budget(simulated_s=240_000.0, cpu_s=240.0)


class WorkStoppedError(KeyboardInterrupt):
    """A computation was stopped before its next simulation, to return the results so far."""


class SpentError(WorkStoppedError):
    """Stopped because the budget of work is spent.  Scenario: a cable that is hard to simulate."""


@dataclass
class Work:
    """Work, counted as seconds of cable motion simulated with `SOLVER`, or its equivalent.

    It can be stopped from another thread or a signal handler.

    budget    of everything since `renew`
    known     text of the intermediate result, for a stop before there is a result
    left_out  names of omitted computations, because the budget was spent
    concluding  stopped or spent: only the results are still compiled
    watcher   receives the error of each model as it is fitted; any thread may call it
    """

    budget: Budget = UNLIMITED
    simulated_s: float = 0.0
    stopped: bool = False
    known: str = ""
    left_out: list[str] = field(default_factory=list)
    _forks_cpu_s: float = 0.0
    _clock_s: float = field(default_factory=computing_s)
    _origin: Budget = NONE
    _limit: Budget | None = None
    _last: Budget | None = None
    concluding: bool = False
    watcher: Callable[[ModelError], None] = _unwatched
    _fitted: dict[tuple[str, ...], ModelError] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        """State for another process: CPU time so far, without the watcher."""
        return {**vars(self), "_forks_cpu_s": self.cpu_s, "watcher": _unwatched}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._clock_s = computing_s()

    @property
    def cpu_s(self) -> float:
        """CPU seconds of this process since creation, and of its forks; without compilation."""
        return computing_s() - self._clock_s + self._forks_cpu_s

    @property
    def done(self) -> Budget:
        """All work so far."""
        return Budget(self.simulated_s, self.cpu_s)

    @property
    def limit(self) -> Budget:
        """Limit of work of the present stage."""
        return self._origin.plus(self.budget) if self._limit is None else self._limit

    @property
    def spent(self) -> bool:
        """Whether the present stage must end: nothing new begins, running fits stop."""
        return self.concluding or self.done.exceeds(self.limit)

    def affords(self, task: str) -> bool:
        """Whether the present stage may begin a computation; if not, it is noted as omitted."""
        if self.spent:
            self.leave_out(task)
            return False
        return True

    def leave_out(self, task: str) -> None:
        """Note an omitted computation by its name."""
        if task not in self.left_out:
            self.left_out.append(task)

    def note_fit(self, names: Iterable[str], rms_m: float, noise_m: float) -> None:
        """Note the error of a fitted model with effects of these names, in m, and the noise."""
        error = ModelError(tuple(sorted(names)), rms_m, noise_m)
        self._fitted[error.effects] = error
        self.watcher(error)

    @property
    def fit_errors(self) -> tuple[ModelError, ...]:
        """Errors of all models fitted so far, by number of effects, the largest error first."""
        errors = self._fitted.values()
        return tuple(sorted(errors, key=lambda e: (len(e.effects), -e.rms_m, e.effects)))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context of one of `STAGES`, which sets the limit."""
        before, self._limit = self._limit, self._origin.plus(self.budget.share(STAGES[name]))
        try:
            yield
        finally:
            self._limit = before

    @contextmanager
    def part(self, share: Budget) -> Iterator[None]:
        """Context of a job with its own share of the work, in this process or in a fork."""
        before = vars(self).copy()
        self.simulated_s, self._forks_cpu_s, self._clock_s = 0.0, 0.0, computing_s()
        self._limit = self._last = share
        try:
            yield
        finally:
            did, stopped = self.done, self.stopped
            vars(self).update(before)
            self.stopped = stopped
            self.simulated_s += did.simulated_s

    def renew(self) -> None:
        """Start a new budget, for another computation with the same study."""
        self._origin, self.concluding = self.done, False

    def stop(self) -> None:
        """Let the next simulation raise WorkStoppedError, unless it was stopped before."""
        self.stopped = not self.concluding

    def conclude(self) -> None:
        """After a stop, or when spent: compute only what the results need."""
        self.stopped, self.concluding = False, True

    def check(self) -> None:
        """Raises WorkStoppedError: it was stopped; SpentError: budget spent."""
        if self.stopped:
            raise WorkStoppedError(self.known)
        if not self.concluding:
            last = self._origin.plus(self.budget) if self._last is None else self._last
            if self.done.exceeds(last.plus(self.budget.share(SLACK))):
                raise SpentError(self.known)

    def add(self, models: int, duration_s: float, solver: Solver) -> None:
        """Count a batch.  Raises WorkStoppedError: it was stopped; SpentError: budget spent."""
        self.check()
        self.simulated_s += models * duration_s * self.cost(solver)

    @staticmethod
    def cost(solver: Solver) -> float:
        """Cost of a second of motion with a solver, relative to `SOLVER`."""
        return solver.segments / SOLVER.segments * SOLVER.step_s / solver.step_s


Job = TypeVar("Job")
JobResult = TypeVar("JobResult")

#: The remaining work is divided by the number of jobs, and at least by the first number, as further
#: jobs may follow.  A job may use this many parts: most use less than one.
FEWEST_PARTS, PARTS_OF_ONE = 4, 1.5


@dataclass(frozen=True)
class _Done(Generic[JobResult]):
    """A job's result, None if its share of the work was spent; its work and process id."""

    result: JobResult | None
    spent: bool
    work: Budget
    process: int


class SideBySide:
    """Runs jobs on all cores; results and counted work are the same as if run one after another.

    A job may run in a copy of this process, so that it must not rely on side effects.  Each has the
    same share of the remaining work, on any core.
    """

    def __init__(self, copies: Forks, work: Work, counted: dict[Any, Any]) -> None:
        self._copies = copies
        self._work = work
        self._counted = counted

    def map(
        self,
        function: Callable[[Job], JobResult],
        jobs: Sequence[Job],
        unfinished: Callable[[Job], JobResult],
        done: Callable[[Job, JobResult], None] = lambda job, result: None,
    ) -> list[JobResult]:
        """Results of one of the functions, in the order of the jobs.

        unfinished  gives the result of a job whose share of the work was spent
        done    callback for each job and result, from any thread
        raises  WorkStoppedError
        """
        work, here = self._work, os.getpid()
        before_s, parts = work.simulated_s, max(FEWEST_PARTS, len(jobs))
        share = work.limit.minus(work.done).share(PARTS_OF_ONE / parts)

        def result_of(job: Job, outcome: _Done[JobResult]) -> JobResult:
            return unfinished(job) if outcome.spent else outcome.result  # type: ignore[return-value]

        outcomes = self._copies.map(
            self._counted[function],
            [(job, share) for job in jobs],
            lambda argument, outcome: done(argument[0], result_of(argument[0], outcome)),
            work.check,
        )
        work.simulated_s = before_s
        for outcome in outcomes:
            work.simulated_s += outcome.work.simulated_s
            work._forks_cpu_s += 0.0 if outcome.process == here else outcome.work.cpu_s
        return [result_of(job, outcome) for job, outcome in zip(jobs, outcomes, strict=True)]


@contextmanager
def side_by_side(
    work: Work,
    functions: Sequence[Callable[[Any], Any]],
    effects: Iterable[type[Effect]],
    jobs: int,
) -> Iterator[SideBySide]:
    """Context in which jobs of these functions run on all cores.

    effects  that their arguments or results may contain
    jobs     most jobs per call of `map`
    """
    counted = {function: _counted(function, work) for function in functions}
    most = min(jobs, threads())
    with forks(list(counted.values()), most=most, known=set(effects)) as copies:
        yield SideBySide(copies, work, counted)


def _counted(
    function: Callable[[Job], JobResult], work: Work
) -> Callable[[tuple[Job, Budget]], _Done[JobResult]]:
    """The function, with its work in the result."""

    def counted(job: tuple[Job, Budget]) -> _Done[JobResult]:
        argument, share = job
        before_s, began_s = work.simulated_s, computing_s()
        result, spent = None, False
        with work.part(share):
            try:
                result = function(argument)
            except SpentError:
                spent = True
        took = Budget(work.simulated_s - before_s, computing_s() - began_s)
        return _Done(result, spent, took, os.getpid())

    return counted
