"""The acceleration that sets the scale of a cable's stiffness: gravity, or what its swing shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.study.data import Study
from cell.study.facts import trial_facts

#: Gravity in the plane below this is no scale: a level plane that is 6° off has as much, m/s².
WEAK_M_PER_S2 = 1.0
#: ω² = 12.362 EI/(ρ L⁴) of a uniform clamped strip (β₁L = 1.8751), and the rigidity 0.4 ρ a L³ that
#: a fit supposes first of a cable pulled by a.
_FIRST_MODE, _SUPPOSED = 12.362, 0.4


def swing_hz(study: Study) -> float | None:
    """Median over trials of the tip's strongest frequency; None if no trial shows one."""
    spectra = [trial_facts(t, study.arc_length_m).spectrum for t in study.trials]
    seen = [s.peaks_hz[0] for s in spectra if s is not None and s.peaks_hz]
    return float(np.median(seen)) if seen else None


def with_pull(study: Study) -> Study:
    """The study with the scale of its cable's stiffness.

    raises  ValueError: gravity is weak, and no trial shows a swing
    """
    return replace(study, pull_m_per_s2=pull_m_per_s2(study))


def pull_m_per_s2(study: Study) -> float | None:
    """Acceleration under which a cable of this size would swing as it is seen to, m/s².

    None where gravity in the plane is not weak: then it is the scale.
    raises  ValueError: gravity is weak, and no trial shows a swing
    """
    if float(np.hypot(*study.gravity_m_per_s2)) >= WEAK_M_PER_S2:
        return None
    seen_hz = swing_hz(study)
    if seen_hz is None:
        raise ValueError(
            "gravity in the plane is weak, and no trial shows a swing after the hand has stopped: "
            "nothing tells the rigidity; record three swings after the motion"
        )
    return (2.0 * np.pi * seen_hz) ** 2 * study.cable.free_length_m / (_SUPPOSED * _FIRST_MODE)
