"""The lab's solver, and the work that simulations are: counted, and bounded by a budget."""

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
    """Receives what is being done: `done` of `total` pieces are finished; 0 of 0 = not counted.

    Any thread may tell it.
    """

    def __call__(self, text: str, done: int = 0, total: int = 0) -> None:
        """Must return at once."""


def no_progress(text: str, done: int = 0, total: int = 0) -> None:
    """A `Progress` that shows nothing."""


@dataclass(frozen=True)
class ModelError:
    """Error of a model that was fitted: rms over the fit trials, per coordinate, and the noise, m.

    effects  in the model, sorted; () = the baseline
    """

    effects: tuple[str, ...]
    rms_m: float
    noise_m: float


def _unwatched(_: ModelError) -> None:
    """A watcher of fits that looks at none."""


#: Within 4 µm (rms over the markers of a swing) of a converged cable.
SOLVER = Solver(segments=32, step_s=1e-3)

#: Stages of a diagnosis, and the share of its budget by which each has ended.  What one does not
#: use is the next one's.
STAGES = {
    "prepare": 0.3,
    "search": 0.55,
    "repeated search": 0.78,
    "conclude": 0.9,
    "strength": 0.97,
    "compare": 1.0,
}
#: Beyond the limit of the budget, or of a job's share, a simulation still begins within this share
#: of the budget: fits end with the iteration that they are at.
SLACK = 0.05


@dataclass(frozen=True)
class Budget:
    """The most work of a computation.

    simulated_s  seconds of cable motion, as `Work` counts them: what is left out because of it is
                 the same on every computer
    cpu_s        of this process and its forks: the outer limit, for simulations that fail and for
                 slow computers
    """

    simulated_s: float = float("inf")
    cpu_s: float = float("inf")

    def share(self, share: float) -> Budget:
        """A share of it."""
        return Budget(share * self.simulated_s, share * self.cpu_s)

    def plus(self, other: Budget) -> Budget:
        """Both together."""
        return Budget(self.simulated_s + other.simulated_s, self.cpu_s + other.cpu_s)

    def minus(self, other: Budget) -> Budget:
        """What remains of it, at least 0."""
        left = self.simulated_s - other.simulated_s, self.cpu_s - other.cpu_s
        return Budget(*(max(0.0, part) for part in left))

    def exceeds(self, other: Budget) -> bool:
        """Whether it is no less in either."""
        return self.simulated_s >= other.simulated_s or self.cpu_s >= other.cpu_s


NONE, UNLIMITED = Budget(0.0, 0.0), Budget()
#: Of a diagnosis with all that belongs to it: less than 60 s of one core.  Where a second of motion
#: costs most, the CPU time ends it; with half as much motion rigs with two effects missing were cut
#: short and `unexplained`.
DIAGNOSIS = Budget(simulated_s=130_000.0, cpu_s=54.0)
#: Of the search for a law among many terms.
DISCOVERY = Budget(simulated_s=240_000.0, cpu_s=240.0)


class WorkStoppedError(KeyboardInterrupt):
    """A computation was stopped before its next simulation, to return the results so far."""


class SpentError(WorkStoppedError):
    """Stopped because the budget of work is spent.  Scenario: a cable that is hard to simulate."""


@dataclass
class Work:
    """Work, counted as seconds of cable motion simulated with `SOLVER`, or its equivalent.

    Whoever waits may stop it from another thread or a signal's handler.

    budget    of everything since `renew`
    known     what is known before there is a result, for whoever stops it then
    left_out  what was not computed because the budget was spent
    concluding  it was stopped or spent: only results are still put together
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
        """What another process goes on with: its clock of CPU time is another, nobody watches."""
        return {**vars(self), "_forks_cpu_s": self.cpu_s, "watcher": _unwatched}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._clock_s = computing_s()

    @property
    def cpu_s(self) -> float:
        """CPU seconds of this process since this was made, and of its forks; without compiling."""
        return computing_s() - self._clock_s + self._forks_cpu_s

    @property
    def done(self) -> Budget:
        """All work so far."""
        return Budget(self.simulated_s, self.cpu_s)

    @property
    def limit(self) -> Budget:
        """Where the present stage has to end."""
        return self._origin.plus(self.budget) if self._limit is None else self._limit

    @property
    def spent(self) -> bool:
        """Whether the present stage has to end: nothing more is begun, a fit ends where it is."""
        return self.concluding or self.done.exceeds(self.limit)

    def affords(self, what: str) -> bool:
        """Whether the present stage may begin something; if not, it is noted as left out."""
        if self.spent:
            self.leave_out(what)
            return False
        return True

    def leave_out(self, what: str) -> None:
        """Note what is not computed."""
        if what not in self.left_out:
            self.left_out.append(what)

    def note_fit(self, names: Iterable[str], rms_m: float, noise_m: float) -> None:
        """Note the error of a fitted model with effects of these names, in m, and the noise."""
        error = ModelError(tuple(sorted(names)), rms_m, noise_m)
        self._fitted[error.effects] = error
        self.watcher(error)

    @property
    def fit_errors(self) -> tuple[ModelError, ...]:
        """Errors of all models fitted so far, by number of effects, the largest error first."""
        found = self._fitted.values()
        return tuple(sorted(found, key=lambda e: (len(e.effects), -e.rms_m, e.effects)))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """One of `STAGES`."""
        before, self._limit = self._limit, self._origin.plus(self.budget.share(STAGES[name]))
        try:
            yield
        finally:
            self._limit = before

    @contextmanager
    def part(self, share: Budget) -> Iterator[None]:
        """A job that has a share of the work for itself, in this process or in a fork of it."""
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
        """Begin a budget: another computation with the same study."""
        self._origin, self.concluding = self.done, False

    def stop(self) -> None:
        """Let the next simulation raise WorkStoppedError, unless it was stopped before."""
        self.stopped = not self.concluding

    def conclude(self) -> None:
        """After it was stopped or spent: only what is needed to tell the results is computed."""
        self.stopped, self.concluding = False, True

    def check(self) -> None:
        """Raises WorkStoppedError: no more simulations are wanted."""
        if self.stopped:
            raise WorkStoppedError(self.known)
        if not self.concluding:
            last = self._origin.plus(self.budget) if self._last is None else self._last
            if self.done.exceeds(last.plus(self.budget.share(SLACK))):
                raise SpentError(self.known)

    def add(self, models: int, duration_s: float, solver: Solver) -> None:
        """Count a batch.  Raises WorkStoppedError: no more are wanted; SpentError: nor afforded."""
        self.check()
        self.simulated_s += models * duration_s * self.cost(solver)

    @staticmethod
    def cost(solver: Solver) -> float:
        """What a second of motion costs with a solver, over what it costs with `SOLVER`."""
        return solver.segments / SOLVER.segments * SOLVER.step_s / solver.step_s


Given = TypeVar("Given")
Returned = TypeVar("Returned")

#: The work that is left is divided by the jobs, and by so many at least: few may be the first of
#: many.  A job may take so many parts of it: most take less than one.
FEWEST_PARTS, PARTS_OF_ONE = 4, 1.5


@dataclass(frozen=True)
class _Done(Generic[Returned]):
    """A result, none if its share of the work was spent before; work; process that did it."""

    result: Returned | None
    spent: bool
    work: Budget
    process: int


class SideBySide:
    """Runs jobs on all cores; results and counted work are the same as if run one after another.

    A job must not change what is looked at later: it may be done in a copy of this process.  Each
    has the same share of the work that is left, whichever core does it.
    """

    def __init__(self, copies: Forks, work: Work, counted: dict[Any, Any]) -> None:
        self._copies = copies
        self._work = work
        self._counted = counted

    def map(
        self,
        function: Callable[[Given], Returned],
        jobs: Sequence[Given],
        unfinished: Callable[[Given], Returned],
        done: Callable[[Given, Returned], None] = lambda job, result: None,
    ) -> list[Returned]:
        """Results of one of the functions, in the order of the jobs.

        unfinished  the result of a job whose share of the work was spent
        done    is told of each as it comes, by any thread
        raises  WorkStoppedError: no more simulations are wanted
        """
        work, here = self._work, os.getpid()
        before_s, parts = work.simulated_s, max(FEWEST_PARTS, len(jobs))
        share = work.limit.minus(work.done).share(PARTS_OF_ONE / parts)

        def result_of(job: Given, found: _Done[Returned]) -> Returned:
            return unfinished(job) if found.spent else found.result  # type: ignore[return-value]

        found = self._copies.map(
            self._counted[function],
            [(job, share) for job in jobs],
            lambda asked, result: done(asked[0], result_of(asked[0], result)),
            work.check,
        )
        work.simulated_s = before_s
        for one in found:
            work.simulated_s += one.work.simulated_s
            work._forks_cpu_s += 0.0 if one.process == here else one.work.cpu_s
        return [result_of(job, one) for job, one in zip(jobs, found, strict=True)]


@contextmanager
def side_by_side(
    work: Work,
    functions: Sequence[Callable[[Any], Any]],
    effects: Iterable[type[Effect]],
    jobs: int,
) -> Iterator[SideBySide]:
    """Context in which jobs of these functions run on all cores.

    effects  that what they take or give may have
    jobs     most that will be given at a time
    """
    counted = {function: _counted(function, work) for function in functions}
    most = min(jobs, threads())
    with forks(list(counted.values()), most=most, known=set(effects)) as copies:
        yield SideBySide(copies, work, counted)


def _counted(
    function: Callable[[Given], Returned], work: Work
) -> Callable[[tuple[Given, Budget]], _Done[Returned]]:
    """The function's result with the work that it has taken."""

    def counted(job: tuple[Given, Budget]) -> _Done[Returned]:
        given, share = job
        before_s, began_s = work.simulated_s, computing_s()
        result, spent = None, False
        with work.part(share):
            try:
                result = function(given)
            except SpentError:
                spent = True
        took = Budget(work.simulated_s - before_s, computing_s() - began_s)
        return _Done(result, spent, took, os.getpid())

    return counted
