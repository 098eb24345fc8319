"""What to do in flight: leave the path, change it, or stop in front of the mouth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.flight.answers import Answers
from cell.flight.correct import LEAST, Tail, best_tail, chance, moved_by
from cell.flight.estimate import deviation
from cell.identify.identified import Identified
from cell.plan.destination import Destination

#: Frames that differ from what is found by so many standard deviations are not explained by it.
MOST_MISFIT = 5.0
#: A decision needs so many frames in which the cable is seen.
LEAST_FRAMES = 10


@dataclass(frozen=True, eq=False)
class Decision:
    """What to do.

    tip_m        (T, 2) as predicted, at the times of the answers, if the path stays; None = unknown
    tail         the change that is worth it; None = there is none
    probability  of passing if the path stays; None = unknown
    withheld     why nothing can be decided; None = it can
    """

    tip_m: FloatArray | None = None
    tail: Tail | None = None
    probability: float | None = None
    withheld: str | None = None

    @property
    def hopeless(self) -> bool:
        """Whether the tip will hardly pass unless the path is changed."""
        return self.probability is not None and self.probability < LEAST


@dataclass(frozen=True, eq=False)
class Flight:
    """An insertion that is being made, and how the cable answers.

    noise_m          standard deviation of the nodes as seen
    lag_s            of the arm
    repeatability_m  standard deviation of the tip's height for reasons that are not the cable's
    """

    answers: Answers
    destination: Destination
    noise_m: float
    lag_s: float
    repeatability_m: float

    def decide(self, t_s: FloatArray, nodes_m: FloatArray, from_s: float) -> Decision:
        """From the frames so far.

        t_s      (frames,) increasing, from when the hand was told to move; frames before are left
                 out
        nodes_m  (frames, nodes, 2) measured, nan = not seen
        from_s   when a change can begin
        """
        used = np.isfinite(nodes_m[:, 0, 0]) & (t_s >= 0.0)
        if used.sum() < LEAST_FRAMES:
            return Decision(withheld=f"the cable is seen in {used.sum()} frames")
        beside = deviation(self.answers, t_s[used], nodes_m[used], self.noise_m)
        if beside.misfit > MOST_MISFIT:
            return Decision(withheld=f"the frames are not explained: misfit {beside.misfit:.1f}")
        asked = self.answers, beside, self.destination
        return Decision(
            self.answers.nodes_m[:, 0] + beside.tip_m,
            best_tail(*asked, from_s, self.lag_s, self.repeatability_m),
            chance(*asked, self.repeatability_m),
        )

    def changed(self, tail: Tail) -> Flight:
        """The same once a change was told: the expected motion is moved by linear answers."""
        return replace(self, answers=moved_by(self.answers, tail, self.lag_s))

    def expecting(self, nodes_m: FloatArray) -> Flight:
        """The same with the expected motion (T, nodes, 2) simulated anew for a changed path."""
        return replace(self, answers=replace(self.answers, nodes_m=nodes_m))


def seen_within_m(identified: Identified) -> float:
    """Standard deviation of nodes in flight, m: a moving cable is seen less well than at rest.

    As the hold's frames were explained.
    """
    return max(identified.noise.std_m, identified.residual_rms_m)
