"""A study less the errors that show beside a model: of mesh, rounding, and a sensor's gain."""

from __future__ import annotations

from cell.cable.arrays import FloatArray
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit
from cell.lab.fit.gain import with_gain_of
from cell.lab.fit.mesh import mesh_error_m, without_mesh_error
from cell.lab.fit.rounding import rounding_error_m, without_rounding_error


def corrected(prepared: PreparedStudy, fit: Fit) -> PreparedStudy:
    """The study with these errors as a model that explains it has them."""
    prepared = without_mesh_error(prepared, fit, mesh_error_m(prepared, fit))
    prepared = without_rounding_error(prepared, rounding_error_m(prepared, fit))
    return with_gain_of(prepared, fit)


def moved_m(before: PreparedStudy, after: PreparedStudy) -> dict[str, FloatArray]:
    """By which a correction moves a study's markers: per trial (times, markers, 2), m."""
    return {t.name: after.taken_out_m(t) - before.taken_out_m(t) for t in after.study.trials}
