"""The lab's solver, and the work that simulations are, counted so that it can be bounded."""

from __future__ import annotations

from dataclasses import dataclass

from cell.cable.solver import Solver

#: Within 4 µm (rms over the markers of a swing) of a converged cable.
SOLVER = Solver(segments=32, step_s=1e-3)


class StoppedError(KeyboardInterrupt):
    """A computation was stopped before its next simulation, to return the results so far."""


@dataclass
class Work:
    """Work, counted as seconds of cable motion simulated with `SOLVER`, or its equivalent.

    Whoever waits may stop it from another thread or a signal's handler.
    """

    simulated_s: float = 0.0
    stopped: bool = False

    def stop(self) -> None:
        """Let the next simulation raise StoppedError."""
        self.stopped = True

    def check(self) -> None:
        """Raises StoppedError: no more simulations are wanted."""
        if self.stopped:
            raise StoppedError

    def add(self, models: int, duration_s: float, solver: Solver) -> None:
        """Count a batch.  Raises StoppedError: no more are wanted."""
        self.check()
        self.simulated_s += models * duration_s * self.cost(solver)

    @staticmethod
    def cost(solver: Solver) -> float:
        """What a second of motion costs with a solver, over what it costs with `SOLVER`."""
        return solver.segments / SOLVER.segments * SOLVER.step_s / solver.step_s
