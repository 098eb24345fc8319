"""Forecasts of recorded motions by a line's present model and by a candidate."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.linalg import block_diag

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable
from cell.cable.solver import DivergedError
from cell.cable.statics import UnsettledError
from cell.files.plain import plain
from cell.identify.individual import CableRejectedError, IdentifyOptions, identify
from cell.identify.model_class import ModelClass
from cell.identify.noise import rms
from cell.lab.data.cycles import RecordedCycle
from cell.lab.fit.shared import BIAS_M, along_end
from cell.lab.line.effect_fit import EffectFit, LearningResult
from cell.plan.destination import Destination
from cell.plan.passage import height_at_opening_m, measured_passage
from cell.study.data import Markers, Trial

#: First share of a hold, from which the remainder is forecast if there is no execution.
FIRST_SHARE = 0.6


@dataclass(frozen=True)
class TipForecast:
    """Errors of the tip as one model forecasts it; `inf` without a forecast, nan if unseen.

    error_m  largest in the destination, or in all frames of the remainder of a hold; without the
             constant offset of the observed end along the cable
    rms_m    over all frames, less sensitive to noise
    cpu_s    CPU time of the identification
    above_m  height of the tip in the opening above its forecast; nan = not executed, or not reached
    """

    error_m: float
    rms_m: float
    cpu_s: float
    above_m: float = float("nan")


@dataclass(frozen=True)
class ForecastPair:
    """Forecasts of one recorded motion by the present and the candidate model.

    candidate  with effects learned from the other cables only
    of         an execution, forecast from that cycle's own hold; for a rejected cable the remainder
               of the hold, forecast from its first frames
    """

    cycle: str
    present: TipForecast
    candidate: TipForecast
    of: Literal["execution", "rest of the hold"] = "execution"

    def to_json(self) -> dict[str, Any]:
        """Plain data; null where there is no error."""
        keys = {"error_m": "m", "cpu_s": "s", "rms_m": "rms_m", "above_m": "above_m"}
        each = {"present": self.present, "candidate": self.candidate}
        of_models = {
            f"{model}_{key}": getattr(forecast, name)
            for name, key in keys.items()
            for model, forecast in each.items()
        }
        return dict(plain({"cycle": self.cycle, "of": self.of, **of_models}))


def forecasts(
    result: LearningResult,
    cable: Cable,
    options: IdentifyOptions,
    destination: Destination,
    known: Sequence[ForecastPair] = (),
) -> list[ForecastPair]:
    """Out-of-sample forecasts of all recorded executions, and of holds without an execution.

    known  as in `judge`
    """
    assert result.best is not None
    at_present = {pair.cycle: pair.present for pair in known}
    pairs = []
    for i, cycle in enumerate(result.cycles):
        if cycle.held is None:
            continue
        kind = with_effect(options.kind, result.best, result.best.fit.without(i), result)
        before = at_present.get(cycle.name) or _forecast(cycle, cable, options, destination)
        after = _forecast(cycle, cable, replace(options, kind=kind), destination)
        pair = ForecastPair(cycle.name, before, after)
        pairs.append(replace(pair, of="rest of the hold") if cycle.executed is None else pair)
    return pairs


def with_effect(
    kind: ModelClass, tried: EffectFit, theta: FloatArray, result: LearningResult
) -> ModelClass:
    """The model class with an effect at theta; covariance: of the fit plus between cables."""
    covariance = tried.fit.covariance.copy()
    covariance[np.diag_indices_from(covariance)] += result.between
    natural, k = tried.fit.natural(theta), len(kind.names)
    joint = block_diag(np.array(kind.covariance).reshape(k, k), covariance)
    return replace(
        kind,
        effects=(*kind.effects, *tried.effects),
        names=(*kind.names, *tried.names),
        mean=(*kind.mean, *(float(natural[i]) for i in tried.fit.common)),
        covariance=tuple(tuple(map(float, row)) for row in joint),
    )


def _forecast(
    cycle: RecordedCycle, cable: Cable, options: IdentifyOptions, destination: Destination
) -> TipForecast:
    """Errors of a model's forecast of a cycle."""
    assert cycle.held is not None
    start_s = time.process_time()
    first, later = cycle.held, cycle.executed
    if later is None:
        first, later = _split(cycle.held)
    markers = later.markers
    try:
        identified = identify(first, cycle.study.arc_length_m, cable, options=options)
        cpu_s = time.process_time() - start_s
        held, tip = (
            simulate(
                identified.model,
                trial.grip,
                trial.markers.t_s,
                cycle.study.arc_length_m[:1],
                solver=options.fit.solver,
            )[0, :, 0]
            for trial in (first, later)
        )
    except (CableRejectedError, DivergedError, UnsettledError):
        return TipForecast(np.inf, np.inf, time.process_time() - start_s)
    observed = markers.xy_m[:, 0] - _end_offset_m(first, held) * along_end(later)
    error_m = np.linalg.norm(observed - tip, axis=1)
    rms_m = rms(error_m)
    if cycle.executed is None:
        largest_m = float(np.nanmax(error_m)) if np.isfinite(rms_m) else rms_m
        return TipForecast(largest_m, rms_m, cpu_s)
    passage = measured_passage(destination, markers.t_s, observed, markers.t_s, tip)
    above_m = passage.miss_m - height_at_opening_m(destination, tip)
    return TipForecast(passage.error_m, rms_m, cpu_s, above_m)


def _end_offset_m(held: Trial, tip: FloatArray) -> float:
    """Constant offset of the observed end along the cable, estimated from a hold, m.

    Clipped to twice the bias of images: the remainder is an error of the model.
    """
    offset = np.sum((held.markers.xy_m[:, 0] - tip) * along_end(held), axis=1)
    observed = offset[np.isfinite(offset)]
    return float(np.clip(observed.mean(), -2.0 * BIAS_M, 2.0 * BIAS_M)) if observed.size else 0.0


def _split(held: Trial) -> tuple[Trial, Trial]:
    """The first frames of a hold, and the others."""
    t_s, xy_m = held.markers.t_s, held.markers.xy_m
    at = int(FIRST_SHARE * len(t_s))
    return (
        replace(held, markers=Markers(t_s[:at], xy_m[:at])),
        replace(held, markers=Markers(t_s[at:], xy_m[at:])),
    )
