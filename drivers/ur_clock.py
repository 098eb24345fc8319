"""A controller's clock in the cell's time, and deadlines in step with its cycle."""

from __future__ import annotations

import math

_DRIFT = 50e-6  # how fast two crystals may part
#: When commands are sent, in periods after the state could have come: late enough for nearly every
#: state, and far from where the controller looks for commands.  How far a period may depart.
_PHASE, _SLEW = 0.4, 0.01


class ControllerClock:
    """Learns from the arrival of states when the controller's cycles are.

    A command that comes while the controller looks for one is taken now in this cycle, now in the
    next; so commands are sent in between, however the two clocks drift.

    period_s  of the controller's cycle, s
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._robot_s = 0.0
        self._offset_s = math.inf

    @property
    def robot_s(self) -> float:
        """Time stamp of the last state, on the controller's clock."""
        return self._robot_s

    @property
    def lead_s(self) -> float:
        """How long before a deadline a state is expected, s."""
        return _PHASE * self._period_s

    def state_before(self, deadline_s: float) -> float:
        """A time on the controller's clock between the stamp of the state that is expected before
        a deadline and the one before that; −inf until any was seen.
        """
        return deadline_s - self.lead_s - self._offset_s - 0.5 * self._period_s

    def saw(self, robot_s: float, now_s: float) -> float:
        """Time on the cell's clock of a state that came now: by the least delay seen so far."""
        drift_s = _DRIFT * (robot_s - self._robot_s)
        self._offset_s = min(self._offset_s + drift_s, now_s - robot_s)
        self._robot_s = robot_s
        return robot_s + self._offset_s

    def in_step(self, deadline_s: float) -> float:
        """A deadline moved by at most a hundredth of a period towards `lead_s` after a state."""
        if not math.isfinite(self._offset_s):
            return deadline_s
        period_s = self._period_s
        late_s = deadline_s - (self._robot_s + self._offset_s + self.lead_s)
        off_s = (late_s + 0.5 * period_s) % period_s - 0.5 * period_s
        most_s = _SLEW * period_s
        return deadline_s - max(-most_s, min(most_s, off_s))
