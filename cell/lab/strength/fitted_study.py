"""The best model of a study, with its own error for noise where it errs by more than the camera."""

from __future__ import annotations

import logging

from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.lab.data.prepared import ERRS, PreparedStudy
from cell.lab.search.explore import Candidate, Explorer
from cell.lab.strength.kept_model import identified

_LOG = logging.getLogger(__name__)


def fit_study(explorer: Explorer) -> tuple[Identified, Candidate, PreparedStudy]:
    """The best model of a study with the effects of the explorer's space; the study as fitted to.

    Where the model errs by more than the camera, its own error is taken for noise and the fit
    repeated, so that the prior keeps a part in what the data then cannot tell.  Its correlation
    widens the intervals and leaves the weight of the frames as it is.
    """
    candidate = explorer.baseline()
    prepared = explorer.prepared
    _LOG.info("fitted %s: %.4f mm", prepared.study.name, candidate.fit.rms_m * 1e3)
    if candidate.fit.rms_m <= ERRS * prepared.expected.std_m:
        return identified(prepared, candidate.fit, explorer.library.values()), candidate, prepared
    left = Noise(candidate.fit.rms_m)
    coarser = Explorer(
        PreparedStudy.of(prepared.measured, misfit=left, solver=prepared.solver),
        explorer.space,
        explorer.library,
        explorer.progress,
        begin=candidate.fit.q if explorer.sought else None,
    )
    candidate = coarser.baseline()
    model = identified(coarser.prepared, candidate.fit, explorer.library.values())
    return model, candidate, coarser.prepared
