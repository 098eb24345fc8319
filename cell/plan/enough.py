"""Whether more frames of a hold could still change how probably the chosen offset passes."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from cell.identify.identified import Identified
from cell.plan.choose import Choice, ChoiceOptions, Forecast, deviates, missed_height_m
from cell.plan.destination import Destination

#: More frames are not worth their time if they would change the probability by less, in the mean.
SMALL_CHANGE = 0.01


def enough_frames(
    choice: Choice,
    expected: Forecast,
    identified: Identified,
    destination: Destination,
    options: ChoiceOptions = ChoiceOptions(),  # noqa: B008
) -> bool:
    """Whether an offset is chosen, and stays as probable however well the cable becomes known.

    A cable that would be rejected is worth all the frames that there are.

    choice  of `expected`, forecast of `identified`
    """
    if not choice.chosen:
        return False
    return expected_change(choice, expected, identified, destination, options) < SMALL_CHANGE


def expected_change(
    choice: Choice,
    expected: Forecast,
    identified: Identified,
    destination: Destination,
    options: ChoiceOptions = ChoiceOptions(),  # noqa: B008
) -> float:
    """By how much the best offset's probability would change in the mean, were the cable known.

    For every cable that this one may be the probability is that of the other reasons alone: what
    the model lacks, arm, camera, draught, of which more frames tell nothing.  Only the nearer edge
    of the mouth counts.
    """
    index = choice.table.index(choice.best)
    shift = deviates(len(identified.mean) + 1, options.samples)[:, :-1] @ identified.root.T
    tips_m = expected.moved_to(identified.mean).tip_m[index] + np.moveaxis(
        expected.sensitivity[index] @ shift.T, -1, 0
    )
    known = ndtr(destination.margin_m(tips_m) / missed_height_m(identified, options))
    return float(np.abs(known - known.mean()).mean())
