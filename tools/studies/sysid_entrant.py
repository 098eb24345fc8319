"""`mujoco.sysid` as an entrant: effects are parameters of a chain that MuJoCo simulates and fits.

The chain is that of `cell export`, so effects that MuJoCo cannot express are not offered; the
camera's latency shifts the times of the markers.  Fits start from this project's baseline, and from
the size of an effect that its score test estimates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.effects.base import Effect
from cell.cable.effects.camera import CameraLatency
from cell.cable.model import CableModel
from cell.cable.statics import UnsettledError
from cell.exchange.chain import chain_of, expressible, physical, resting_bends, value, why_not
from cell.exchange.mjcf import mjcf, resting_qpos, without_log
from cell.identify.parameters import ParameterSpace
from cell.lab.fit.fitting import fit_trials, space_with, with_values
from cell.lab.search.fit_cache import FitCache
from cell.study.data import Trial

#: Links, and MuJoCo's step, s, for a cable of 0.1 m; longer ones are slower.
LINKS, STEP_S, LENGTH_M = 16, 1.5e-3, 0.1
#: Effects that are fitted at each level, the likeliest of a score test; iterations of a fit, and
#: of the best one; step of a difference, over the parameter's own.
OPTIONS, ITERATIONS, POLISH, DIFFERENCE = 5, 3, 8, 0.3
#: Whitened residual of a cable that diverges.
DIVERGED = 1e3


def markers(model: CableModel, trial: Trial, arc_length_m: np.ndarray) -> np.ndarray:
    """(times, markers, 2) by MuJoCo, nan where the chain diverges."""
    import mujoco
    from mujoco import rollout

    chain = chain_of(expressible(physical(model))[0], LINKS)
    t_s, shape = trial.markers.t_s, (*trial.markers.xy_m.shape,)
    xml = mjcf(chain, STEP_S * np.sqrt(model.cable.free_length_m / LENGTH_M), np.zeros(LINKS + 1),
               ())  # fmt: skip
    peer = mujoco.MjModel.from_xml_string(xml)
    h, begin = float(peer.opt.timestep), float(trial.grip.t_s[0])
    steps = int((t_s[-1] + 0.02 - begin) / h) + 1
    times = begin + h * np.arange(-1, steps + 2)
    path = np.stack([spline(times) for spline in trial.grip.splines], axis=1)
    path[0] = path[1]  # from rest
    bends = resting_bends(expressible(physical(model))[0], LINKS, float(path[1, 2]))
    data = mujoco.MjData(peer)
    data.qpos[:] = resting_qpos(chain, path[1], bends)
    first = np.zeros(mujoco.mj_stateSize(peer, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(peer, data, first, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    control = np.diff(path, 2, axis=0)[:steps] / h**2
    with without_log():
        state, _ = rollout.rollout(peer, data, first[None], control[None])
    q = np.vstack([first[None, 1 : peer.nq + 1], state[0, :, 1 : peer.nq + 1]])[::4]
    if not np.all(np.isfinite(q)) or np.abs(q[:, 3:]).max() > 4.0:
        return np.full(shape, np.nan)
    own = 3 + bool(chain.grip)
    clamp = q[:, 2] + chain.grip_angle_rad + (q[:, 3] if chain.grip else 0.0)
    angles = np.column_stack([clamp, clamp[:, None] + np.cumsum(q[:, own : own + LINKS], axis=1)])
    ends = np.cumsum(chain.link_m)
    knots = np.concatenate([[0.0], ends[1:] - 0.5 * chain.link_m[1:], ends[-1:]])
    fine = np.linspace(0.0, ends[-1], 8 * LINKS + 1)
    angle = CubicSpline(knots, np.column_stack([angles, angles[:, -1]]), axis=1)(fine)
    along = -np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = CubicSpline(fine, along, axis=1).antiderivative()(np.minimum(arc_length_m, ends[-1]))
    points = points + q[:, None, :2]
    stored_s = begin + 4 * h * np.arange(len(q))
    delay_s = value(model, CameraLatency, "delay_s")
    return np.asarray(CubicSpline(stored_s, points)(np.clip(t_s - delay_s, begin, stored_s[-1])))


def residual_of(fits: FitCache, space: ParameterSpace) -> Callable[[np.ndarray], np.ndarray]:
    """Whitened residual (values, lanes) of coordinates (p, lanes) of a space."""
    prepared, trials = fits.prepared, fit_trials(fits.prepared)

    def lane(q: np.ndarray) -> np.ndarray:
        model, parts = space.model(q), []
        for trial in trials:
            try:
                points = markers(model, trial, prepared.study.arc_length_m)
            except (UnsettledError, ValueError):
                points = np.full(trial.markers.xy_m.shape, np.nan)
            white = prepared.white(trial, points[None])[0]
            parts.append(np.where(np.isfinite(white), white, DIVERGED))
        return np.concatenate(parts)

    return lambda q: np.stack([lane(column) for column in q.T], axis=1)


def fitted(
    fits: FitCache, space: ParameterSpace, start: np.ndarray, iterations: int
) -> tuple[float, np.ndarray]:
    """χ² and coordinates of the result of `mujoco.sysid` from a start."""
    from mujoco import sysid

    free = np.flatnonzero(space.high > space.low)
    step, residual = space.step[free], residual_of(fits, space)

    def coordinates(x: np.ndarray) -> np.ndarray:
        q = np.tile(start[:, None], (1, x.shape[1]))
        q[free] += step[:, None] * x
        return q

    def of_parameters(x: np.ndarray, _: Any) -> tuple[list[np.ndarray], None, None]:
        residuals = residual(coordinates(x.reshape(len(free), -1)))
        return [residuals[:, 0] if x.ndim == 1 else residuals], None, None

    low, high = ((edge[free] - start[free]) / step for edge in (space.low, space.high))
    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("q", np.zeros(len(free)), low, high))
    _, result = sysid.optimize(parameters, of_parameters, verbose=False, max_iters=iterations,
                               eps=DIFFERENCE)  # fmt: skip
    q = coordinates(np.asarray(result.x).reshape(len(free), 1))
    return float(np.sum(residual(q) ** 2)), q[:, 0]


def costs(fits: FitCache, most: int) -> dict[frozenset[str], float]:
    """BIC of the sets of a forward search over effects that the chain can express."""
    base, count = fits.base.fit, fits.prepared.count(fit_trials(fits.prepared))
    starts = {s.effect: s.starts[0] for s in fits.screened(fits.base)}  # the likeliest first
    usual = replace(base.model, effects=())
    expressed = [e for e in starts if _is_expressed(e, usual)]

    def bic(
        effects: Sequence[type[Effect]], q: np.ndarray, iterations: int = ITERATIONS
    ) -> tuple[float, np.ndarray]:
        chi2, q = fitted(fits, space_with(base.space, effects), q, iterations)
        return chi2 + (len(q) - len(base.q)) * float(np.log(count)), q

    here: list[type[Effect]] = []
    cost, q = bic(here, base.q, POLISH)
    by_set = {frozenset[str](): cost}
    for _ in range(most):
        space, options = space_with(base.space, here), {}
        for effect in [e for e in expressed if e not in here][:OPTIONS]:
            wider = space_with(base.space, [*here, effect])
            more = wider.mean.copy()
            more[[wider.names.index(n) for n in space.names]] = q
            options[effect] = bic([*here, effect], with_values(wider, more, effect, starts[effect]))
            by_set[frozenset(e.name for e in [*here, effect])] = options[effect][0]
        effect = min(options, key=lambda e: options[e][0])
        polished = bic([*here, effect], options[effect][1], POLISH)
        by_set[frozenset(e.name for e in [*here, effect])] = polished[0]
        if polished[0] >= cost:
            break
        here, (cost, q) = [*here, effect], polished
    return by_set


def _is_expressed(effect: type[Effect], model: CableModel) -> bool:
    size = {p.name: p.starts[0] for p in effect.parameters}
    return effect is CameraLatency or why_not(effect.active(**size), model) is None
