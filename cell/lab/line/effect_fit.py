"""Effects fitted to many cables together, and the limit of work for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import Options
from cell.lab.data.cycles import RecordedCycle
from cell.lab.data.work import Budget, Work
from cell.lab.fit.fitting import Rival
from cell.lab.fit.shared import PASSES, SharedFit, Spread

#: Fits whose χ² is within this factor of the best are continued to convergence.
NEAR, ALL_PASSES = 2.0, replace(PASSES, max_iterations=30)
#: Relative error of an effect's change by `shared.SOLVER`: of two equivalent effects, delays of arm
#: and camera, the true one explained less, by 0.4 % of it.
SIMULATED = 0.005
#: Iterations of the last fit, to all cables, that the budget always allows.
LEAST_PASSES = 6
#: Effects are one class if their χ², over its inflation, differs by less; as in a diagnosis.
TIE = 9.0
#: Budget of simulated motion for a result, s, counted as in `work.Work` (three to four minutes of
#: one core), and of CPU time, s.
MOST_SIMULATED_S, MOST_CPU_S = 80_000.0, 480.0


@dataclass(eq=False)
class LearningBudget:
    """The limit of simulated work, and notes on what was omitted because of it.

    most_s  seconds of cables' motion
    most_cpu_s  of CPU time, the outer limit: simulations that fail count for little motion
    cables  notes on cables that are not used for learning
    """

    most_s: float = MOST_SIMULATED_S
    most_cpu_s: float = MOST_CPU_S
    work: Work = field(default_factory=Work)
    left_out: list[str] = field(default_factory=list)
    cables: list[str] = field(default_factory=list)

    def allows(self, share: float, task: str) -> bool:
        """Whether less than a share of it is spent; if not, `task` is noted as omitted."""
        limit = Budget(self.most_s, self.most_cpu_s).share(share)
        if not self.work.done.exceeds(limit):
            return True
        self._leave_out(task)
        return False

    def passes(self, each_s: float, options: Options, task: str) -> Options:
        """Options of a fit with as many iterations as the remaining budget allows.

        each_s  seconds simulated per iteration
        """
        affordable = max(LEAST_PASSES, int((self.most_s - self.work.simulated_s) / each_s))
        if affordable >= options.max_iterations:
            return options
        self._leave_out(f"{task} after {affordable} passes")
        return replace(options, max_iterations=affordable)

    def _leave_out(self, task: str) -> None:
        note = f"{task}, for the limit of {self.most_s:.0f} s of simulated motion"
        if note not in self.left_out:
            self.left_out.append(note)


@dataclass(frozen=True, eq=False)
class EffectFit:
    """Effects fitted to several cables, their parameters shared.

    effects  in the order in which they were added to the model
    fall     of χ² by the last of them, over the residuals' inflation
    p_value  of it, adjusted for the size of the library
    """

    effects: tuple[type[Effect], ...]
    fit: SharedFit
    fall: float
    p_value: float

    @property
    def effect(self) -> type[Effect]:
        """The effect that was added last."""
        return self.effects[-1]

    @property
    def name(self) -> str:
        """Names of the effects."""
        return " + ".join(e.name for e in self.effects)

    @property
    def firsts(self) -> tuple[int, ...]:
        """Index of the first fitted parameter of each effect among the shared ones."""
        owners = [n.partition(".")[0] for n in self.names]
        return tuple(owners.index(e.name) for e in self.effects)

    @property
    def names(self) -> tuple[str, ...]:
        """Shared parameters, as `effect.parameter`."""
        return tuple(self.fit.space.names[i] for i in self.fit.common)

    def on_next_cable(self) -> Rival:
        """The prediction of a cable not measured yet, from mean and spread of these cables."""
        fit, space = self.fit, self.fit.space
        n, own, common = len(fit.cables), fit.own, fit.common
        covariance = np.zeros((len(space.names), len(space.names)))
        for i in range(n):
            block = slice(i * own, (i + 1) * own)
            covariance[:own, :own] += fit.inflation * fit.solution.covariance[block, block] / n
        if n > 1:
            covariance[:own, :own] += np.cov(fit.q.T)
        covariance[np.ix_(common, common)] = fit.covariance
        q = space.mean.copy()
        q[:own], q[common] = fit.q.mean(axis=0), fit.theta
        return Rival(self.name, space, q, covariance)


def is_tied(other: EffectFit, best: EffectFit) -> bool:
    """Whether an effect fits as well as the best, or would if its fit had converged.

    The tolerance allows for noise and for the simulation's own error.
    """
    remaining = other.fit.solution.promised if other.fit.chi2 < NEAR * best.fit.chi2 else 0.0
    tolerance = max(TIE, SIMULATED**2 * best.fall)
    return best.fall - other.fall - remaining / best.fit.inflation < tolerance


def library_first(ranked: Sequence[EffectFit]) -> list[EffectFit]:
    """Fits, likeliest first, but an effect of the library before a file's law that it ties with."""
    named = [t for t in ranked[:1] if t.effect.file is not None]
    same = [t for t in ranked[1:] if named and t.effect.file is None and is_tied(t, ranked[0])]
    return sorted(ranked, key=lambda t: t is not same[0]) if same else list(ranked)


@dataclass(frozen=True)
class CycleEvidence:
    """Evidence of one cycle for or against the effect that was added last.

    fall    of its own χ² over the inflation: positive speaks for the effect
    value   of its first parameter from this cable alone
    std     of that
    """

    cycle: str
    fall: float
    value: float
    std: float


@dataclass(frozen=True, eq=False)
class LearningResult:
    """The result of learning from many cables: the missing effects, or that none is missing.

    cycles    used for learning, as in `cycle_evidence`
    baseline  the present model, fitted to them
    ranking   effects refitted in addition to the previous ones, the likeliest first
    best      the likeliest, fitted to all of `cycles`; None = nothing significant is missing
    tied      effects that explain as much as the last of `best`
    spread    of the first parameter of each effect of `best` between cables
    cycle_evidence   for and against the last effect of `best`
    simpler   the result without the last effect; None = there is one effect, or none
    left_out  notes on work omitted by the budget, and on cables that the model does not fit
    cables_left_out   notes on other cables not, or not completely, used for learning
    """

    cycles: tuple[RecordedCycle, ...]
    baseline: SharedFit
    ranking: tuple[EffectFit, ...] = ()
    best: EffectFit | None = None
    tied: tuple[str, ...] = ()
    spread: tuple[Spread, ...] = ()
    cycle_evidence: tuple[CycleEvidence, ...] = ()
    simpler: LearningResult | None = None
    left_out: tuple[str, ...] = ()
    cables_left_out: tuple[str, ...] = ()

    @property
    def between(self) -> FloatArray:
        """(m,) variance of each shared parameter between cables."""
        assert self.best is not None
        variance = np.zeros(len(self.best.names))
        for i, spread in zip(self.best.firsts, self.spread, strict=True):
            variance[i] = spread.tau**2
        return variance

    def rivals(self) -> list[Rival]:
        """Predictions for the next cable by the best effect and those tied; empty without ties."""
        likeliest = self.ranking[:1] if self.tied else ()
        tied = [t for t in self.ranking[1:] if t.effect.name in self.tied]
        return [t.on_next_cable() for t in (*likeliest, *tied)]
