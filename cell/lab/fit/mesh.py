"""The study corrected for the error of a model's mesh, so that it does not count as a misfit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.whitening import arcs_are_uncertain, whiteners_of
from cell.lab.fit.fitting import Fit, best_initial_states

#: The mesh and the step are this many times finer in the simulation that tells their errors, which
#: fall with the square of both: what it still errs by is this share of the difference.
FINER = 2
LEFT = 1.0 / (FINER**2 - 1.0)
#: An error that moves no parameter by more than this share of its standard deviation changes no
#: answer.
NOTICEABLE = 0.5
#: Of a difference by which a marker's place changes with its arc length, as a share of the cable.
SLOPE_STEP = 0.005


def finer(prepared: PreparedStudy) -> PreparedStudy:
    """The same on the finer mesh."""
    coarse = prepared.solver
    return replace(
        prepared,
        slopes=None,
        solver=Solver(
            FINER * coarse.segments, coarse.step_s / FINER, coarse.damping, coarse.threads
        ),
    )


def mesh_error_m(prepared: PreparedStudy, fit: Fit) -> dict[str, FloatArray]:
    """What the solver's mesh errs by in a fitted model, less what has been taken out already.

    By trial (times, markers, 2), m, of those that can be simulated on both meshes.
    source  Richardson's extrapolation
    """
    trials = prepared.study.trials
    initial_states = best_initial_states(prepared, fit)
    here = prepared.predict_all(trials, [fit.model], initial_states)
    there = finer(prepared).predict_all(trials, [fit.model], initial_states)
    found = {}
    for trial, coarse, fine in zip(trials, here, there, strict=True):
        error_m = (1.0 + LEFT) * (fine[0] - coarse[0])
        if np.all(np.isfinite(error_m)):
            found[trial.name] = error_m - prepared.mesh_m.get(trial.name, 0.0)
    return found


def matters(prepared: PreparedStudy, error_m: Mapping[str, FloatArray]) -> bool:
    """Whether such an error would move some parameter by a noticeable part of its deviation.

    Whitened it is a vector: along no direction does it move the residuals by more than its length.
    """
    square = 0.0
    for trial in prepared.study.trials:
        if (moved := error_m.get(trial.name)) is not None:
            both = prepared.white(trial, np.stack([moved, np.zeros_like(moved)]))
            square += float(np.sum((both[0] - both[1]) ** 2))
    return square > NOTICEABLE**2


def without_mesh_error(
    prepared: PreparedStudy, fit: Fit, error_m: Mapping[str, FloatArray]
) -> PreparedStudy:
    """The study less what a converged mesh would show beside the solver's.

    A mesh's error moves little with the parameters, so that one fit tells it for all: without it
    an effect that resembles it (`grip_slip`) is found in long records of a long or soft cable.
    error_m  of `mesh_error_m`
    source   deferred correction (Stetter 1978, Numer. Math. 29, 425)
    """
    shown = []
    for trial in prepared.study.trials:
        if (moved := error_m.get(trial.name)) is not None:
            seen = trial.markers.xy_m - moved
            trial = replace(trial, markers=replace(trial.markers, xy_m=seen))
        shown.append(trial)
    study = replace(prepared.study, trials=tuple(shown))
    states = best_initial_states(prepared, fit)
    lines = lines_of(prepared, fit.model, states) if arcs_are_uncertain(study) else {}
    whiteners = whiteners_of(study, prepared.noise, prepared.gauges, lines, prepared.levels)
    taken = {n: e + prepared.mesh_m.get(n, 0.0) for n, e in error_m.items()}
    mesh_m = {**prepared.mesh_m, **taken}
    return replace(prepared, study=study, whiteners=whiteners, mesh_m=mesh_m, lines=lines)


def lines_of(
    prepared: PreparedStudy, model: CableModel, initial_states: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Per trial (times, markers, 2) change of a model's markers by a metre of arc length.

    What is measured of it errs with the markers that it is to explain: in long records that alone
    looks like a cable of another length.
    initial_states  by trial (1, unknowns); as noted where it is missing
    """
    study, trials = prepared.study, prepared.study.trials
    arcs_m, step_m = study.arc_length_m, SLOPE_STEP * study.cable.length_m
    ends_m = [np.clip(arcs_m + d, 0.0, study.cable.length_m) for d in (-step_m, step_m)]
    below, above = (
        replace(prepared, study=replace(study, arc_length_m=at_m)).predict_all(
            trials, [model], initial_states
        )
        for at_m in ends_m
    )
    found = {}
    for trial, low, high in zip(trials, below, above, strict=True):
        moved = (high - low)[0, :, : len(arcs_m)] / (ends_m[1] - ends_m[0])[:, None]
        seen = np.isfinite(trial.markers.xy_m[:, : len(arcs_m)]).any(axis=0)
        if np.all(np.isfinite(moved)):
            found[trial.name] = np.where(seen, moved, 0.0)
    return found
