"""Settings of a simulation: mesh, step, damping and threads; its errors; the integrator."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.assembly import DEFAULT_SEGMENTS


@dataclass(frozen=True)
class Solver:
    """Mesh and step of a simulation, and its largest number of threads.

    segments  4 … 10000
    step_s    the grid of steps is shared by all lanes of a batch
    damping   ρ∞ of generalised-α, 0 … 1: amplitude of an infinitely fast mode after one step
    threads   most threads; None = number of cores that this process may use
    """

    segments: int = DEFAULT_SEGMENTS
    step_s: float = 0.75e-3
    damping: float = 0.8
    threads: int | None = None

    def __post_init__(self) -> None:
        if not 4 <= self.segments <= 10_000:
            raise ValueError(f"solver.segments = {self.segments}: must be 4 … 10000")
        if not 1e-6 <= self.step_s <= 0.05:
            raise ValueError(f"solver.step_s = {self.step_s} s: must be 1e-6 … 0.05 s")
        if not 0.0 <= self.damping <= 1.0:
            raise ValueError(f"solver.damping = {self.damping}: must be 0 … 1")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"solver.threads = {self.threads}: must be at least 1, or None")


DEFAULT_SOLVER = Solver()


class LanesError(RuntimeError):
    """Lanes of a batch cannot be simulated; `lanes` are their numbers."""

    def __init__(self, lanes: Sequence[int], message: str) -> None:
        super().__init__(message)
        self.lanes = tuple(lanes)


class DivergedError(LanesError):
    """A simulation diverged.  Scenario: a step far too long for a fast, soft cable.

    lanes   the lanes that had diverged when it was detected; the first is in the message
    """

    def __init__(self, lanes: Sequence[int], time_s: float, step_s: float) -> None:
        super().__init__(
            lanes,
            f"lane {lanes[0]} diverged at t = {time_s:.4f} s (not finite, or a hinge bent by half "
            f"a turn); use a shorter step than {step_s * 1e3:g} ms or check the parameters",
        )
        self.time_s = time_s


_ALONE = ContextVar("one_core", default=False)


@contextmanager
def one_core() -> Iterator[None]:
    """Context in which simulations use one core, so that several processes run in parallel."""
    before = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(before)


def threads() -> int:
    """Cores that this process may use; 1 within `one_core`."""
    if _ALONE.get():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def generalised_alpha(step_s: float, damping: float) -> FloatArray:
    """Coefficients of a step: see `stepping.predict` and `stepping.advance`.

    [0] h, [1] ∂q/∂a, [2] ∂v/∂a at the collocation time, [3] v, [4] a_old in q, [5] a_old in v,
    [6], [7] a_new from a and a_old, [8], [9] a_old, a_new in q, [10], [11] in v, [12] the
    collocation time in steps.
    """
    h = step_s
    mass = (2.0 * damping - 1.0) / (damping + 1.0)
    force = damping / (damping + 1.0)
    gamma = 0.5 - mass + force
    beta = 0.25 * (1.0 - mass + force) ** 2
    c = 1.0 - force
    new, old = 1.0 / (1.0 - mass), -mass / (1.0 - mass)
    q_old, v_old = h * h * (0.5 - beta), h * (1.0 - gamma)
    q_new, v_new = h * h * beta, h * gamma
    return np.array(
        [
            h,
            c * q_new * new,
            c * v_new * new,
            c * h,
            c * (q_old + q_new * old),
            c * (v_old + v_new * old),
            new,
            old,
            q_old,
            q_new,
            v_old,
            v_new,
            c,
        ]
    )
