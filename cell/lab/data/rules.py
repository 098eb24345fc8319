"""Limits of the lab for accepting an effect and for calling a model complete."""

from __future__ import annotations

from dataclasses import dataclass

from cell.lab.data.check import OwnCheck
from cell.lab.data.noise_model import KNOWN_WITHIN
from cell.lab.data.prepared import ERROR_RATIO

#: Family-wise error rate: probability of a false effect, law or disagreement over all tests of a
#: question.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Rules:
    """Limits for accepting an effect and for calling a model complete, and the extent of a search.

    Probabilities:
    significance         of an effect on the fit trials, or on all of them given the final model,
                         family-wise over the library (Holm); and of the smooth part of half an
                         effect: if that is not detectable, no claim is made, because an effect
                         outside the library might look the same
    residual_significance  below which a residual is more than noise; above `small_share` of the
                         baseline's excess, `significance` is the limit

    Likelihoods:
    heldout_gain     required ln likelihood ratio of the held-out trials by an effect: in total, and
                     by the effect alone, the other parameters as fitted.  Below it alone, they
                     cannot detect it, and the total gain is due to other parameters
    tie_delta_chi2   sets of effects are tied if their χ² over all trials differs by less
    vuong_z          where no set of effects explains the study, sets are tied if their residuals
                     differ by fewer standard deviations.  For white noise 1.5 is Δχ² = 9; with
                     covariances over a quarter of the frames that becomes 2 (Kiefer and Vogelsang
                     2005, Econometric Theory 21, 1130)

    Errors, rms over noise; a smooth part matters above the same share of the noise's mean square:
    most_over_noise  up to which a model's own error explains it: converged simulators of one cable
                     differ by less
    below_stated     an error below this share of a stated noise is within the measurement's
                     uncertainty: no further effect is claimed
    noise_known_within   largest allowed upper bound of the noise's mean square, over the estimate

    Shares.  Below the first two lie the errors of models, ours included, whatever their
    significance:
    negligible_share   required fall of the held-out mean square by an effect: the first, of the
                       noise's; further ones, of the baseline's excess; and the part of that excess
                       that another effect may explain given the final model
    slight_share       of the noise's mean square: required fall of the held-out one by further
                       effects; of the baseline's excess: smooth part, other than noise, allowed in
                       the residual of a claimed effect
    small_share        of the baseline's excess: above it a smooth part is tested at `significance`;
                       of the χ² that an effect explains: below it held-out trials cannot show it
    most_share         required removed share of an error by a partial effect; remaining share after
                       two effects at which a search ends without exchanges

    Numbers:
    most_named       effects added one after another, tied, or listed as nearest: more than three
                     cannot be tested; a partial explanation has one less
    least_heldout    independent held-out trials, of motions not fitted to, required for a claim
    max_unconfirmed  effects needed only because of an earlier cable's model: none, because this
                     study alone is no evidence for them
    max_refits       effects of the screen that are refitted, in addition to all non-smooth ones

    own              a user's own checks, in addition to those of the lab
    """

    significance: float = SIGNIFICANCE
    residual_significance: float = 1e-3
    heldout_gain: float = 3.0
    tie_delta_chi2: float = 9.0
    vuong_z: float = 2.0
    most_over_noise: float = ERROR_RATIO
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
