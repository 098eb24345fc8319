"""Wrong priors: models of earlier cables that are wrong for a study; four kinds.

plain         a plain fit to the same cable with an effect of 1 … 5 times its typical size, which
              the study has as well, and an additional load
another       a plain fit to another cable; the study has an effect
stiffer       a plain fit to the same cable, all of EI three times as large; nothing is hidden
wrong shapes  a plain fit to another cable, its markers wrong by 2 … 5 mm, the same for four
              frames, which its study states; the study has an effect
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.api.lab import fit_study
from cell.cable.effects import library
from cell.identify.identified import Identified
from cell.lab.data.named_effects import EffectSelection
from cell.lab.search.setup import fit_cache_of
from cell.study.data import Markers, Study
from tools.worlds.made_studies import coloured, hidden, make_study

BAD_PRIORS = ("plain", "another", "stiffer", "wrong shapes")
#: Trials of a study with a bad prior.
TRIALS = ("identify", "deep")
#: Number of frames with the same wrong shape.
UPDATES = 4


def with_bad_prior(seed: int, kind: str) -> tuple[Study, tuple[str, ...], Identified]:
    """A study, the effects hidden in it, and an earlier cable's model of a kind."""
    rng = np.random.default_rng([seed, 3])
    known = library()
    name = str(rng.choice([n for n in known if n != "tip_mass"]))
    there = [hidden(known[name], float(np.exp(rng.uniform(0.0, np.log(5.0)))))]
    before = list(there) if kind == "plain" else []
    if kind == "plain":
        there.append(hidden(known["tip_mass"], float(np.exp(rng.uniform(0.0, np.log(5.0))))))
    elif kind == "stiffer":
        there = []
    same = kind in ("plain", "stiffer")
    other_seed = 50_000 + seed
    earlier = _short(make_study(seed if same else other_seed, before, noise_seed=other_seed))
    if kind == "wrong shapes":
        earlier = _with_wrong_shapes(rng, earlier)
    model, *_ = fit_study(fit_cache_of(earlier, EffectSelection((), library())))
    if kind == "stiffer":
        mean = model.mean.copy()
        mean[: model.space.knots] += np.log(3.0)
        model = replace(model, mean=mean)
    study = _short(make_study(seed, there))
    return study, tuple(a.effect.name for a in there), model


def _short(study: Study) -> Study:
    """The study with a few of its trials."""
    return replace(study, trials=tuple(t for t in study.trials if t.name in TRIALS))


def _with_wrong_shapes(rng: np.random.Generator, study: Study) -> Study:
    """The study with smooth stated errors of millimetres along the cable, like a fitted shape."""
    error_m = rng.uniform(2e-3, 5e-3)
    trials = []
    for trial in study.trials:
        frames, markers, _ = trial.markers.xy_m.shape
        drawn = coloured(rng, (frames // UPDATES + 1, 3, 2), 0.5)
        along = np.vander(np.linspace(0.0, 1.0, markers), 4)[:, :3]
        along /= np.sqrt(np.mean(np.sum(along**2, axis=1)))
        wrong = error_m * np.einsum("mk,tkc->tmc", along, np.repeat(drawn, UPDATES, axis=0))
        shifted = Markers(trial.markers.t_s, trial.markers.xy_m + wrong[:frames])
        trials.append(replace(trial, markers=shifted))
    return replace(study, trials=tuple(trials), noise_std_m=error_m)
