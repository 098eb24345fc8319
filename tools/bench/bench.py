"""Speed of the cable engine, as ratios against a peer in the same run, and the cell's wait for it.

The peer is MuJoCo's own batch runner, `mujoco.rollout`, with as many threads as cores.  It gets
the engine's own mesh, the best known to us: thin rods hinged between the nodes, the clamp's
hinges corrected; its integrator and step are searched for the fastest within the same error.
"""

from __future__ import annotations

import argparse
import time
import traceback

import numpy as np

from cell.cable import layout as at
from cell.cable.assembly import assemble
from cell.cable.dynamics import simulate
from cell.cable.effects import air as air_family
from cell.cable.effects import library, load_effect
from cell.cable.model import CableModel
from cell.cable.solver import Solver, generalised_alpha, threads
from cell.cable.statics import settle
from cell.cable.stepping import integrate, looks
from cell.identify.differences import difference_points
from cell.identify.parameters import ParameterSpace, Prior
from tools.bench.bench_task import (
    ALLOWED_M,
    ARC,
    CABLE,
    DURATION_S,
    MODEL,
    MOTIONS,
    TIMES,
    best_of,
    tip_error,
)


def our_solver(exact: np.ndarray, segments: int | None) -> tuple[Solver, float]:
    """The fastest of our settings within the error allowed."""
    meshes = (segments,) if segments else (8, 10, 12, 14, 16, 20)
    found = []
    for n in meshes:
        for step in (5e-3, 4e-3, 3e-3, 2.5e-3, 2e-3, 1.5e-3, 1e-3):
            solver = Solver(n, step)
            tips = simulate(MODEL, MOTIONS, TIMES, ARC[:1], solver=solver)[:, :, 0]
            error = tip_error(tips, exact)
            if error <= ALLOWED_M:
                found.append((n / step, solver, error))
                break
    _, solver, error = min(found, key=lambda f: f[0])
    return solver, error


def against_mujoco() -> None:
    from tools.bench.bench_mujoco import fastest_peer  # needs mujoco

    exact = simulate(MODEL, MOTIONS, TIMES, ARC[:1], solver=Solver(160, 1e-4))[:, :, 0]
    print(f"\n21 offsets, {DURATION_S:g} s each, {threads()} threads, both within 50 µm rms")
    for segments, meshes in ((None, (8, 10, 12)), (40, (40,))):
        print(f"\n {'any mesh' if segments is None else f'{segments} segments'}")
        peer, peer_error, _ = fastest_peer(exact, meshes)
        solver, error = our_solver(exact, segments)
        run, pool = peer.runner()

        def ours(solver: Solver = solver) -> object:
            return simulate(MODEL, MOTIONS, TIMES, ARC, solver=solver)

        mine, theirs = best_of(ours, run, rounds=5)
        cpu_s = best_of(ours, run, rounds=5, clock=time.process_time)
        pool.close()  # type: ignore[attr-defined]
        print(
            f"  MuJoCo  {peer.segments:3d} segments, {peer.integrator}, {peer.step_s * 1e3:g} ms: "
            f"{peer_error * 1e6:5.1f} µm, {theirs * 1e3:8.2f} ms\n"
            f"  engine  {solver.segments:3d} segments, {solver.step_s * 1e3:g} ms: "
            f"{error * 1e6:5.1f} µm, {mine * 1e3:8.2f} ms"
        )
        name = f"MuJoCo / engine, {segments or 'any'} segments"
        report(name, theirs / mine, ">=", 20.0)
        # what other programs hardly change: on a busy computer the ratio above is chance
        report(f"{name}, CPU time of all threads", cpu_s[1] / cpu_s[0], ">=", 40.0)


# --- the engine against itself ------------------------------------------------------------------


def linear_cost() -> None:
    print("\ncost of a step of 16 lanes against the number of segments")
    sizes = (10, 20, 40, 80, 160)
    runs, counts = [], [4000 // n for n in sizes]
    for n, steps in zip(sizes, counts, strict=True):
        (block,) = assemble([MODEL] * at.LANES, n, 0.0)
        base = np.zeros(steps * at.BASE_FIELDS * at.LANES)
        settle(block, base)
        fresh = at.vectors(n + 1, at.FIELDS).reshape(block.state.shape)
        fresh[:] = block.state

        def run(
            block: object = block, fresh: np.ndarray = fresh, base: np.ndarray = base, n: int = n
        ) -> None:
            out = np.empty(0)
            integrate(
                fresh, at.LANES, n, base, generalised_alpha(1e-4, 0.8), False, 1,
