"""A study made ready again, for another noise of its measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cell.cable.arrays import FloatArray
from cell.lab.data.gauges import scaled
from cell.lab.data.noise_model import NoiseModel, noise_model_of_residuals
from cell.lab.data.prepared import PreparedStudy, of_frames
from cell.lab.data.whitening import whiteners_of


def judged_by(prepared: PreparedStudy, errors: Sequence[FloatArray]) -> PreparedStudy:
    """The same with the correlations of a stated error as a model's residuals have them.

    errors  per trial to be fitted (times, channels), m, nan where not seen
    """
    if not prepared.noise_is_measured:
        return prepared
    fitted, columns = prepared.study.role("fit"), 2 * len(prepared.study.arc_length_m)
    places = [of_frames(prepared, t, e)[:, :columns] for t, e in zip(fitted, errors, strict=True)]
    noise_model = noise_model_of_residuals(prepared.noise_model, places)
    unchanged = noise_model == prepared.noise_model
    return prepared if unchanged else with_noise_model(prepared, noise_model)


def with_noise_model(
    prepared: PreparedStudy,
    noise_model: NoiseModel,
    of_gauges: tuple[NoiseModel, NoiseModel] | None = None,
) -> PreparedStudy:
    """The same, whitened for another noise of the measurement.

    of_gauges  noise of force and moment, if there are gauges and it is another, too
    """
    weighed = noise_model.weighed
    same = noise_model.levels == prepared.noise_model.levels
    if weighed == prepared.noise and same and of_gauges is None:
        return replace(prepared, noise_model=noise_model)
    levelled = _levelled(prepared, noise_model.noise.std_m, of_gauges)
    whiteners = whiteners_of(
        levelled.study, weighed, levelled.gauges, levelled.lines, noise_model.levels
    )
    return replace(levelled, noise_model=noise_model, noise=weighed, whiteners=whiteners)


def _levelled(
    prepared: PreparedStudy, std_m: float, of_gauges: tuple[NoiseModel, NoiseModel] | None
) -> PreparedStudy:
    """The same with gauges in the unit of such a noise."""
    if prepared.gauges is None:
        return prepared
    force, moment = of_gauges or (prepared.gauges.force, prepared.gauges.moment)
    gauges = replace(prepared.gauges, std_m=std_m, force=force, moment=moment)
    factors = gauges.scale / prepared.gauges.scale
    mesh_m = {name: error_m.copy() for name, error_m in prepared.mesh_m.items()}
    for error_m in mesh_m.values():
        error_m[:, gauges.markers :] *= factors
    study = scaled(prepared.study, gauges, factors)
    return replace(prepared, study=study, gauges=gauges, mesh_m=mesh_m)
