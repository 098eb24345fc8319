"""Limits of the lab for accepting an effect and for calling a model complete."""

from __future__ import annotations

from dataclasses import dataclass

from cell.lab.data.check import OwnCheck
from cell.lab.data.noise_model import KNOWN_WITHIN
from cell.lab.data.prepared import ERRS

#: Probability of calling something an effect, a law, a disagreement that is none, for all tests of
#: a question together.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Rules:
    """Limits for accepting an effect and for calling a model complete, and the extent of a search.

    Probabilities:
    significance         of an effect on the fit trials, or on all of them given what was found,
                         family-wise over the library (Holm); and of the smooth part of half an
                         effect: if the trials would not show it, no claim is made, because an
                         effect of no library might look the same
    residual_significance  below which what a model leaves is more than noise; where it leaves more
                         than `small_share` of the baseline's excess, `significance` is the limit

    Likelihoods:
    heldout_gain     ln of how much likelier an effect must make the held-out trials: in all, and by
                     itself, all else as fitted.  If by itself it makes them less so, they cannot
                     see it, and what they gain comes by other parameters
    tie_delta_chi2   sets of effects are tied if their χ² over all trials differs by less
    vuong_z          where no set of effects leaves noise, one that leaves less by fewer standard
                     deviations than this is tied with what leaves more.  For white noise 1.5 is
                     Δχ² = 9; with covariances over a quarter of the frames that becomes 2
                     (Kiefer and Vogelsang 2005, Econometric Theory 21, 1130)

    Errors, rms over noise; a smooth part matters above the same share of the noise's mean square:
    most_over_noise  up to which a model's own error explains it: converged simulators of one cable
                     differ by less
    below_stated     a stated noise of which a model leaves less than this share bounds what the
                     measurement can be trusted for: below it nothing more is claimed
    noise_known_within   largest mean square over the noise's that the rest may allow

    Shares.  Below the first two lie the errors of models, ours included, whatever their
    significance:
    negligible_share   by which an effect must lower the held-out mean square: the first, of the
                       noise's; further ones, of the baseline's excess; and of that excess, what
                       another effect may explain given what was found
    slight_share       of the noise's mean square, by which further effects must lower the held-out;
                       and of the baseline's excess, that a claimed effect may leave in a smooth
                       part that is not noise
    small_share        a small part: of the baseline's excess, above which a smooth part that is
                       left counts at `significance`; of the χ² that an effect explains, below
                       which held-out trials cannot show it
    most_share         most: of an error that a partial effect removes; that two effects leave,
                       where a search ends, and none of them is exchanged

    Numbers:
    most_named       effects added one after another, tied, or told as nearest: more than three
                     cannot be tested; a partial explanation has one less
    least_heldout    independent trials that must be held out for a claim, of motions not fitted to
    max_unconfirmed  effects that only an earlier cable's model asks for: none, because this study
                     alone is no evidence for them
    max_refits       of the screen that are refitted, besides all that are not smooth

    own              a user's own checks, in addition to those of the lab
    """

    significance: float = SIGNIFICANCE
    residual_significance: float = 1e-3
    heldout_gain: float = 3.0
    tie_delta_chi2: float = 9.0
    vuong_z: float = 2.0
    most_over_noise: float = ERRS
    below_stated: float = 0.8
    noise_known_within: float = KNOWN_WITHIN
    slight_share: float = 0.01
    negligible_share: float = 1e-3
    small_share: float = 0.1
    most_share: float = 0.5
    most_named: int = 3
    least_heldout: int = 1
    max_unconfirmed: int = 0
    max_refits: int = 6
    own: tuple[OwnCheck, ...] = ()


DEFAULT_RULES = Rules()
