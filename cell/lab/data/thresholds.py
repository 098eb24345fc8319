"""Limits of the lab for accepting an effect and for calling a model complete."""

from __future__ import annotations

from dataclasses import dataclass

from cell.lab.data.noise_floor import KNOWN_WITHIN

#: Probability of calling something an effect, a law, a disagreement that is none, for all tests of
#: a question together.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Rules:
    """Limits at which an effect is accepted and a model called complete.

    significance     family-wise, over the library (Holm), on the fit trials
    heldout_gain     ln of how much likelier the held-out trials must become
    least_visible    ln of how much likelier the effect itself, all else as fitted, must make them:
                     below, they cannot see it, and what they gain comes by other parameters
    heldout_insensitive  effects that the held-out trials see by less than this share of the χ² that
                     they explain of the fit trials are found, but not confirmed
    first_share, more_share, excess_share   least fall of the held-out mean square: of the noise's
                     for the first effect and for more, and of the baseline's excess for more.
                     Below lie the errors of models, ours included, whatever their significance
    tie_delta_chi2  sets of effects are tied if their χ² over all trials differs by less
    vuong_z  where no set of effects leaves noise, one that leaves less by fewer standard
                     deviations than this is tied with what leaves more.  Beside white noise 1.5 is
                     Δχ² = 9; with covariances over a quarter of the frames that becomes 2
                     (Kiefer and Vogelsang 2005, Econometric Theory 21, 1130)
    max_tied        more than these tied: these motions cannot tell
    max_effects     added one after another
    max_refits  of the screen that are refitted, besides all that are not smooth
    below_stated     a stated noise of which a model leaves less than this share bounds what the
                     measurement can be trusted for: below it nothing more is claimed
    misfit_significance   of what a model leaves on the held-out trials
    misfit, gross_misfit  rms over noise from which that matters; and does whatever it was before
    misfit_share          of the baseline's excess that a known effect may leave below the latter
    smooth_shares, gross_smooth_misfit   a claimed effect may leave such a share of the baseline's
                     excess, below so much of the noise's mean square, in a smooth part that is not
                     noise at that significance; a complete model nothing at `misfit_significance`
    law_share        a claimed effect's wider law must not explain more than its own by more than
                     such a share of the baseline's excess, at `misfit_significance`
    half_seen        significance at which the trials must be able to show half of an
                     effect's smooth part, or else it is not told from effects of no library
    least_share       of the error beyond noise that an effect removes if it explains most, not all
    nearest          effects that an unexplained study is told of
    least_heldout    held-out trials that confirm an effect
    max_prior_driven   effects that only an earlier cable's model asks for
    noise_known_within  largest mean square over the noise's that the rest may allow
    max_simulated_s  after so many seconds of motion simulated no further effect is sought; some
                     twenty seconds on two cores, and as much again for what was begun
    first_effects, hopeless_left, unexchanged_left   after so many effects no more are sought if a
                     larger share than this of the error beyond noise is left, and none exchanged
                     if more than the last is: of two that together explain it, one alone explains
                     half, unless they work against each other
    """

    significance: float = SIGNIFICANCE
    heldout_gain: float = 3.0
    least_visible: float = 1.0
    heldout_insensitive: float = 0.1
    first_share: float = 0.003
    more_share: float = 0.01
    excess_share: float = 0.001
    tie_delta_chi2: float = 9.0
    vuong_z: float = 2.0
    max_tied: int = 3
    max_effects: int = 3
    max_refits: int = 6
    below_stated: float = 0.8
    least_heldout: float = 1.0
    max_prior_driven: float = 0.0
    noise_known_within: float = KNOWN_WITHIN
    misfit: float = 1.04
    gross_misfit: float = 1.10
    misfit_share: float = 0.1
    misfit_significance: float = 1e-3
    gross_smooth_misfit: float = 0.2
    smooth_shares: tuple[tuple[float, float], ...] = ((0.01, 1e-3), (0.1, 0.01))
    law_share: float = 1e-3
    half_seen: float = 0.05
    least_share: float = 0.5
    nearest: int = 3
    max_simulated_s: float = 40_000.0
    first_effects: int = 2
    hopeless_left: float = 0.1
    unexchanged_left: float = 0.5


DEFAULT_RULES = Rules()
