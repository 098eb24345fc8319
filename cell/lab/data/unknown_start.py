"""The unknown initial state of a trial, fitted with the cable: a release is not logged.

The true release of a straight cable is a few milliseconds before or after the recorded time.  A
cable held bent, or moving at the start of the record, differs from its equilibrium by a few modes
of vibration of unknown amplitude, and of unknown velocity if it moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.cable.swing import ROOTS
from cell.study.data import Trial

#: Uncertainty of the recorded time of a release by a person, s: standard deviation, and limit.
RELEASE_STD_S = 0.02
RELEASE_LIMIT_S = 0.1
#: Modes by which a cable may differ from its equilibrium; a force at the tip of a straight cable
#: bends it to 3e-4 of its deflection by these.
MODES = 4
#: Standard deviation of the first mode's amplitude, in free lengths; that of a shorter wave scales
#: with its square, as for cables held by fingers, and its velocity with the wave length.
PLACE_STD = 0.5
#: Velocities are of swings within twice √(g/L).
PACE = 2.0
_DELAY_STEP_S = 1e-4
_MODE_STEP = 1e-4
#: Bounds of a mode, in standard deviations.
_FARTHEST = 4.0


@dataclass(frozen=True, eq=False)
class InitialState:
    """The unknowns of a trial's state, 0 = as recorded: delay of a release, places, velocities.

    std, step, limit  (unknowns,) of the prior, of finite differences, largest magnitude
    """

    delayed: bool
    places: int
    velocities: int
    std: FloatArray
    step: FloatArray
    limit: FloatArray

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return int(self.delayed) + self.places + self.velocities

    @property
    def bent(self) -> bool:
        """Whether the cable may begin away from its equilibrium."""
        return self.places > 0

    def delay_s(self, initial_states: FloatArray) -> FloatArray:
        """(lanes,) delays among unknowns (lanes, unknowns)."""
        return initial_states[:, 0] if self.delayed else np.zeros(len(initial_states))

    def modes(self, initial_states: FloatArray) -> FloatArray:
        """(2, `MODES`) places and velocities among unknowns (unknowns,)."""
        modes = np.zeros((2, MODES))
        modes.ravel()[: self.places + self.velocities] = initial_states[int(self.delayed) :]
        return modes


def initial_state_of(trial: Trial, cable: Cable, scale_m_per_s2: float) -> InitialState:
    """The unknowns of a trial's initial state.

    scale_m_per_s2  acceleration of the cable's time scale, see `Study`
    """
    delayed = trial.start in ("straight", "held")
    places = MODES if trial.bent else 0
    velocities = MODES if trial.start == "moving" else 0
    wave = ROOTS[0] / np.array(ROOTS[:MODES])
    pace_per_s = PACE * np.sqrt(scale_m_per_s2 / cable.free_length_m)
    place = PLACE_STD * wave[:places] ** 2
    velocity = PLACE_STD * pace_per_s * wave[:velocities]
    steps = np.full(places, _MODE_STEP), np.full(velocities, pace_per_s * _MODE_STEP)
    std = np.concatenate([[RELEASE_STD_S] * delayed, place, velocity])
    step = np.concatenate([[_DELAY_STEP_S] * delayed, *steps])
    limit = np.concatenate([[RELEASE_LIMIT_S] * delayed, _FARTHEST * place, _FARTHEST * velocity])
    return InitialState(delayed, places, velocities, std, step, limit)
