"""How often the lab claims an effect where none is, or calls complete what errs.

    python -m tools.studies.false_alarm_study [--studies 200] [--first 0] [--bad-priors]

Complete studies, AR(1) noise of 0 … 0.9.  With `--bad-priors` each study, of one fitted trial and
one held out, is diagnosed beside the model of another that is no model of it, one of four kinds in
turn:

    plain         a plain fit to the same cable with an effect of 1 … 5 times its typical size,
                  which the study has as well, and a load besides
    another       a plain fit to another cable; the study has an effect
    stiffer       a plain fit to the same cable, all of EI three times as large; nothing is hidden
    wrong shapes  a plain fit to another cable, its markers wrong by 2 … 5 mm, the same for four
                  frames, which its study states; the study has an effect

None may be called complete that errs by more than 3 times its noise.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from cell.api.fitted_study import fit_study
from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Diagnosis
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose
from cell.study.data import Markers, Study
from tools.worlds.made_studies import coloured, hidden, make_study

BAD_PRIORS = ("plain", "another", "stiffer", "wrong shapes")
#: Trials of a study beside a bad prior.
TRIALS = ("identify", "deep")
#: Error over noise from which a model must not be called complete.
MOST_LEFT = 3.0
#: Frames for which a wrong shape stays the same.
UPDATES = 4


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--bad-priors", action="store_true")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.studies)
    return _with_bad_priors(seeds) if given.bad_priors else _complete(seeds)


def _complete(seeds: range) -> int:
    """Studies that lack nothing."""
    verdicts: dict[str, int] = {}
    for seed in seeds:
        study = make_study(seed)
        prepared = PreparedStudy.of(study)
        found = diagnose(FitCache(prepared, ParameterSpace.of(study.cable), library())).diagnosis
        verdicts[found.verdict] = verdicts.get(found.verdict, 0) + 1
        named = ", ".join(f.effect for f in found.missing)
        noise = prepared.noise_model.noise
        print(f"{seed:4d}  noise {noise.std_m * 1e3:.3f} mm, AR {noise.ar1:.2f}  "
              f"{found.verdict} {named}", flush=True)  # fmt: skip
    false = len(seeds) - verdicts.get("complete", 0)
    print(f"\n{verdicts}\nfalse claims: {_share(false, len(seeds))}")
    return 0 if false <= 0.05 * len(seeds) else 1


def _with_bad_priors(seeds: range) -> int:
    """Studies beside a model that is none of theirs."""
    verdicts: dict[str, int] = {}
    false = wrong = 0
    for seed in seeds:
        kind = BAD_PRIORS[seed % len(BAD_PRIORS)]
        there, found = beside_bad_prior(seed, kind)
        worst_m = max(found.baseline.fit_rms_m, found.baseline.heldout_rms_m)
        over = worst_m / found.noise_m
        named = found.missing if found.verdict == "missing" else found.partial
        claims = [{f.effect, *f.tied_with} for f in named]
        false += found.verdict == "complete" and over > MOST_LEFT
        wrong += any(not names & set(there) for names in claims)
        verdicts[found.verdict] = verdicts.get(found.verdict, 0) + 1
        said = ", ".join(" or ".join(sorted(names)) for names in claims)
        print(f"{seed:4d}  prior {kind}; hidden {', '.join(there) or 'nothing'}: {found.verdict}, "
              f"error over noise {over:.1f}; {said}", flush=True)  # fmt: skip
    print(
        f"\n{verdicts}\ncomplete above {MOST_LEFT:g} times the noise: "
        f"{_share(false, len(seeds))}\nclaims of what is not there: {_share(wrong, len(seeds))}"
    )
    return 0 if false == 0 else 1


def beside_bad_prior(seed: int, kind: str) -> tuple[tuple[str, ...], Diagnosis]:
    """The effects hidden in a study, and what is said of it beside a prior of a kind."""
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
    other = 50_000 + seed
    earlier = _short(make_study(seed if same else other, before, noise_seed=other))
    if kind == "wrong shapes":
        earlier = _with_wrong_shapes(rng, earlier)
    model, *_ = fit_study(fit_cache_of(earlier, EffectSelection((), library())))
    if kind == "stiffer":
        mean = model.mean.copy()
        mean[: model.space.knots] += np.log(3.0)
        model = replace(model, mean=mean)
    study = _short(make_study(seed, there))
    prior = (Path("earlier.json"), model)
    found = diagnose(fit_cache_of(study, EffectSelection((), library()), prior)).diagnosis
    return tuple(a.effect.name for a in there), found


def _short(study: Study) -> Study:
    """The study with few of its trials."""
    return replace(study, trials=tuple(t for t in study.trials if t.name in TRIALS))


def _with_wrong_shapes(rng: np.random.Generator, study: Study) -> Study:
    """Markers wrong by millimetres, smoothly along the cable, as a fitted shape is; it says so."""
    error_m = rng.uniform(2e-3, 5e-3)
    trials = []
    for trial in study.trials:
        frames, markers, _ = trial.markers.xy_m.shape
        drawn = coloured(rng, (frames // UPDATES + 1, 3, 2), 0.5)
        along = np.vander(np.linspace(0.0, 1.0, markers), 4)[:, :3]
        along /= np.sqrt(np.mean(np.sum(along**2, axis=1)))
        wrong = error_m * np.einsum("mk,tkc->tmc", along, np.repeat(drawn, UPDATES, axis=0))
        seen = Markers(trial.markers.t_s, trial.markers.xy_m + wrong[:frames])
        trials.append(replace(trial, markers=seen))
    return replace(study, trials=tuple(trials), noise_std_m=error_m)


def _share(count: int, of: int) -> str:
    high = stats.beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    return f"{count} of {of} = {count / of:.1%} (95 %: up to {high:.1%})"


if __name__ == "__main__":
    sys.exit(main())
