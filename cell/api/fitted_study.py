"""The best model of a study; its own error counts as noise where it exceeds the camera's."""

from __future__ import annotations

import logging

from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.lab.data.prepared import ERRS, PreparedStudy, as_measured
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.strength.kept_model import identified

_LOG = logging.getLogger(__name__)


def fit_study(fits: FitCache) -> tuple[Identified, FittedModel, PreparedStudy]:
    """The best model of a study with the effects of the fit cache's space; the study as fitted to.

    Where the model errs by more than the camera, its own error is taken for noise and the fit
    repeated, so that the prior keeps a part in what the data then cannot tell.  Its correlation
    widens the intervals and leaves the weight of the frames as it is.
    """
    candidate = fits.baseline()
    prepared = fits.prepared
    _LOG.info("fitted %s: %.4f mm", prepared.study.name, candidate.fit.rms_m * 1e3)
    if candidate.fit.rms_m <= ERRS * prepared.expected_m("fit"):
        return identified(prepared, candidate.fit, fits.library.values()), candidate, prepared
    left = Noise(candidate.fit.rms_m)
    coarser = FitCache(
        PreparedStudy.of(
            as_measured(prepared), misfit=left, solver=prepared.solver, work=prepared.work
        ),
        fits.space,
        fits.library,
        fits.progress,
        begin=candidate.fit.q if fits.sought else None,
    )
    candidate = coarser.baseline()
    model = identified(coarser.prepared, candidate.fit, fits.library.values())
    return model, candidate, coarser.prepared
