"""The coarsest time step for simulations of which only differences are taken, as measured.

Where a model puts the markers must be right to a part of the noise.  What a parameter or an effect
changes of that need only be right to a part of the change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.identify.gauss_newton import jacobian_at
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit, fit_trials, problem_of

#: Steps tried, in units of the solver's.
LONGER = (3.0, 2.0)
#: Largest error of a parameter's slopes, as a share of them and of what the prior knows.
HARMLESS = 0.02


def with_slopes(prepared: PreparedStudy, fit: Fit) -> tuple[PreparedStudy, Fit]:
    """The study with the longest step of time that leaves the slopes of a fit as they are.

    And the fit with slopes by that step: what is compared with them will be simulated so too.
    """
    if prepared.slopes is not None:
        return prepared, fit
    trials, jacobian = fit_trials(prepared), fit.solution.jacobian
    known = np.diag(problem_of(prepared, fit.space, trials).precision)
    size = np.sqrt(np.sum(jacobian**2, axis=0) + known)
    for longer in LONGER:
        solver = replace(prepared.solver, step_s=longer * prepared.solver.step_s)
        problem = problem_of(replace(prepared, solver=solver), fit.space, trials)
        near = jacobian_at(problem, fit.solution.q, fit.solution.covariance)
        if np.all(np.linalg.norm(near - jacobian, axis=0) <= HARMLESS * size):
            solution = replace(fit.solution, jacobian=near)
            return replace(prepared, slopes=solver), replace(fit, solution=solution)
    return prepared, fit
