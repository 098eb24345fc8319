"""Commands of the lab as functions: fit, compare, diagnose, suggest, power."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from cell.api.results import CompareResult, DiagnoseResult, FitResult, PowerResult, SuggestResult
from cell.cable.model import CableModel
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.lab.data.check import read_own_checks
from cell.lab.data.named_effects import (
    EffectSelection,
    candidates_in,
    select_effects,
    select_for_diagnosis,
)
from cell.lab.data.opened_study import open_study
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy, as_measured
from cell.lab.data.rules import DEFAULT_RULES, Rules
from cell.lab.data.work import DIAGNOSIS, Progress, SpentError, Work, WorkStoppedError, no_progress
from cell.lab.diagnosis import diagnose as examine
from cell.lab.diagnosis import with_strength
from cell.lab.next.advice import Paths, advice
from cell.lab.next.effect_query import effect_queries
from cell.lab.next.study_power import power_of
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.setup import (
    check_same_kind,
    fit_cache_of,
    read_kind,
    read_model,
    read_prior,
    without_outliers,
)
from cell.lab.strength.compare import Comparison, compare_model, model_names
from cell.lab.strength.estimate import identified
from cell.lab.strength.trial_agreement import agreement
from cell.lab.verdict.checks import CHECKS
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.doubts import fit_doubts, lacking_doubt
from cell.lab.verdict.knots import with_more_knots
from cell.study.data import Study
from cell.study.folder import check_study
from cell.study.independence import without_copies

_LOG = logging.getLogger(__name__)


#: A study, or the folder of one or of a recorded cycle.
StudyOrFolder = Study | Path | str
T = TypeVar("T")
#: Callback that receives notes on what is odd about a study, one sentence each.
Tell = Callable[[Sequence[str]], None]


def several(values: Sequence[T]) -> tuple[T, ...]:
    """The argument as a tuple; a single value, such as one name, becomes a tuple of one.

    raises  TypeError: a table, of which only the names would count
    """
    if isinstance(values, Mapping):
        raise TypeError(f"{values!r} is a table; give a list, with sizes as text: ['air_drag=2']")
    alone = isinstance(values, str) or not isinstance(values, Iterable)
    return (values,) if alone else tuple(values)  # type: ignore[return-value]


def effect_names(names: Sequence[Path | str], argument: str = "effects") -> tuple[str, ...]:
    """Effects' names and paths of users' files, as text.  Raises TypeError: one is neither."""
    for each in (effects := several(names)):
        if not isinstance(each, str | Path):
            raise TypeError(f"{argument}: {each!r} is no effect; give a name, or a file.py")
    return tuple(map(str, effects))


def check_study_argument(study: object) -> None:
    """Raise TypeError if it is neither a study nor a folder."""
    if not isinstance(study, Study | Path | str):
        raise TypeError(f"study: {study!r} is none; give its folder, or a Study")


def read_study(folder: Path | str) -> Study:
    """A study, by its folder or that of a recorded cycle; its notes say what is odd about it.

    raises  InputError: file, line, what is wrong, and how to mend it
            TypeError: it is no folder
    """
    check_study_argument(folder)
    return open_study(Path(folder))


def fit(
    study: StudyOrFolder,
    *,
    effects: Sequence[Path | str] = (),
    prior: Path | str | None = None,
    config: Path | str | None = None,
    progress: Progress = no_progress,
) -> FitResult:
    """Fit the cable's parameters, and those of effects, to the trials of role `fit`.

    effects  part of the model: names of the library, or files of your own (`effect.py`)
    prior    model of an earlier cable, written by `FitResult.write`
    config   settings of a cell, whose `model` is the model to start from
    progress callback that receives the current step, and how much of it is done
    raises   InputError, ValueError: study, effect or model is wrong, and how to mend it;
             FileNotFoundError: there is no such file of an effect
    """
    return fitted(set_up(study, select_effects(effect_names(effects)), prior, config, progress))


def compare(
    study: StudyOrFolder,
    models: Sequence[FitResult | Identified | Path | str],
    *,
    names: Sequence[str] | None = None,
) -> CompareResult:
    """Compare models with every trial of a study.

    models  in the order in which they were made
    names   distinct labels of the models; default: their effects
    raises  InputError, ValueError: there is no model, or one is of a different kind of cable, or
            cannot be read
    """
    opened, sources = opened_study(study), several(models)
    if not sources:
        raise ValueError("models: there is none; give one or more")
    shown = [_model(m, opened) for m in sources]
    titles = _titles(sources, shown) if names is None else list(several(names))
    if len(titles) != len(shown):
        raise ValueError(f"names: {len(titles)} for {len(shown)} models; give one for each")
    if names is not None and (twice := [n for n in titles if titles.count(n) > 1]):
        raise ValueError(f"names: {twice[0]!r} is given twice; give each a name of its own")
    named = zip(shown, titles, strict=True)
    work = Work(DIAGNOSIS)
    return CompareResult(tuple(compare_model(opened, m.model, name, work) for m, name in named))


def diagnose(
    study: StudyOrFolder,
    *,
    effects: Sequence[Path | str] = (),
    candidates: Path | str | None = None,
    known: Sequence[Path | str] = (),
    checks: Sequence[Path | str] = (),
    prior: Path | str | None = None,
    config: Path | str | None = None,
    progress: Progress = no_progress,
) -> DiagnoseResult:
    """Find the physical effect that the model lacks, if it lacks one.

    effects  files of your own effects, tried in addition to the library
    candidates  a folder of such files; those that cannot be used are skipped with a warning;
             one that could do more than compute is not run
    known    effects that are part of the model
    checks   files of your own checks, in addition to those of the lab
    other arguments and errors as of `fit`
    """
    rules, tried = rules_with(several(checks)), list(effect_names(effects))
    if candidates is not None:
        good, refused = candidates_in(Path(candidates), progress)
        tried += good
        for why in refused:
            warnings.warn(why, stacklevel=2)
    selection = select_for_diagnosis(tried, effect_names(known, "known"))
    fits = set_up(study, selection, prior, config, progress)
    return diagnosed(examined(fits, rules), _place(study))


def suggest(
    study: StudyOrFolder,
    *,
    effects: Sequence[Path | str] = (),
    known: Sequence[Path | str] = (),
    prior: Path | str | None = None,
    config: Path | str | None = None,
    progress: Progress = no_progress,
) -> SuggestResult:
    """Suggest the safe motion that best distinguishes the effects that may be missing.

    effects  files of your own effects, added to the library; or `NAME`, `NAME=SIZE` of effects
             that the motion is to show, without a diagnosis
    config   settings of the cell, for its limits too; other arguments and errors as of `diagnose`
    """
    from cell.lab.next.suggest import (
        showing_motion,
        split_effects,
        suggest_motion,  # settings: a fifth of a second
    )
    from cell.settings.surroundings import Surroundings

    around = Surroundings.read(None if config is None else Path(config))
    names, tried = split_effects(effect_names(effects))
    known = effect_names(known, "known")
    if names:
        chosen, selection = effect_queries(names, known)
        fits = set_up(study, selection, prior, config, progress)
        return SuggestResult(showing_motion(fits, chosen, around))
    fits = set_up(study, select_for_diagnosis(tried, known), prior, config, progress)
    examination = examine(fits)
    fits.work.renew()
    return SuggestResult(suggest_motion(examination, around))


def power(
    study: StudyOrFolder,
    effects: Sequence[str],
    *,
    verify: int = 0,
    motions: Sequence[Path | str] = (),
    known: Sequence[Path | str] = (),
    config: Path | str | None = None,
    progress: Progress = no_progress,
) -> PowerResult:
    """Forecast which effects a diagnosis of a study like this would find, and from which size on.

    effects  `NAME`, `NAME=SIZE` or `NAME.PARAMETER=SIZE`, SIZE in the parameter's unit; without it
             the smallest that is detected
    verify   copies of the study, the effect hidden in each, that are diagnosed
    motions  files of `cell suggest`, as if they had been recorded too and held out
    other arguments and errors as of `diagnose`
    """
    chosen, selection = effect_queries(effect_names(effects), effect_names(known, "known"))
    if not chosen:
        raise ValueError("effects: there is none; give one or more")
    fits = set_up(study, selection, None, config, progress)
    return PowerResult(power_of(planned(fits, several(motions)), chosen, verify, progress=progress))


def planned(fits: FitCache, motions: Sequence[Path | str]) -> FitCache:
    """The fits, with motions of `cell suggest` files, from the gripper's home, held out."""
    from cell.lab.next.motion_file import hand_motion
    from cell.lab.next.simulated import with_motions

    if not motions:
        return fits
    first = fits.prepared.study.trials[0].grip
    home = float(first.x_m[0]), float(first.y_m[0])
    return with_motions(fits, [hand_motion(Path(file), home) for file in motions])


def silent(_: Sequence[str]) -> None:
    """A `Tell` that discards the notes; they stay in the result's study."""


def set_up(
    study: StudyOrFolder,
    selection: EffectSelection,
    prior: Path | str | None = None,
    config: Path | str | None = None,
    progress: Progress = no_progress,
    tell: Tell = silent,
    work: Work | None = None,
) -> FitCache:
    """The fits of a study, with the files of models and settings that are named.

    work  budget of the study, which can be stopped from outside; None = that of a diagnosis
    """
    return set_up_opened(opened_study(study), selection, prior, config, progress, tell, work)


def set_up_opened(
    opened: Study,
    selection: EffectSelection,
    prior: Path | str | None = None,
    config: Path | str | None = None,
    progress: Progress = no_progress,
    tell: Tell = silent,
    work: Work | None = None,
) -> FitCache:
    """As `set_up`, for a study that `opened_study` has opened."""
    work = Work(DIAGNOSIS) if work is None else work
    tell(opened.notes)
    model = read_prior(None if prior is None else Path(prior), selection.own)
    kind = read_kind(None if config is None else Path(config))
    try:
        fits = fit_cache_of(opened, selection, model, progress, kind, work)
        with work.stage("prepare"):
            fits, notes = without_outliers(fits)
    except SpentError as error:
        raise ValueError(
            f"study {opened.name}: the limit of work was reached before a model was fitted "
            f"({work.simulated_s:.0f} s of simulated motion, {work.cpu_s:.0f} s of CPU time): give "
            "fewer or shorter trials, and check the frame, the datasheet and how the trials begin"
        ) from error
    tell(notes)
    return fits


def fit_study(fits: FitCache) -> tuple[Identified, FittedModel, PreparedStudy]:
    """Best model of a study with the effects of its space, its fit, and the study as fitted to.

    Where the model error exceeds the camera noise, it is used as noise and the fit repeated, so
    that the prior keeps its weight where the data are not informative.  The correlation of this
    error widens the intervals and does not change the weights of the frames.
    """
    model, prepared = fits.base, fits.prepared
    _LOG.info("fitted %s: %.4f mm", prepared.study.name, model.fit.rms_m * 1e3)
    if model.fit.rms_m <= ERROR_RATIO * prepared.expected_m("fit"):
        return identified(prepared, model.fit, fits.library.values()), model, prepared
    again = PreparedStudy.of(
        as_measured(prepared),
        misfit=Noise(model.fit.rms_m),
        solver=prepared.solver,
        work=prepared.work,
    )
    start_q = model.fit.q if fits.setup.unknown_effects else None
    coarser = FitCache.of(
        SearchSetup(again, fits.space, fits.library, fits.progress, start_q=start_q)
    )
    of_all = identified(coarser.prepared, coarser.base.fit, fits.library.values())
    return of_all, coarser.base, coarser.prepared


def fitted(fits: FitCache) -> FitResult:
    """The fitted model of a prepared study; if interrupted, the result so far."""
    fits = with_more_knots(fits, fits) or fits
    model, candidate, fitted_to = fit_study(fits)
    lacking = lacking_doubt(model.lacks)
    result = FitResult(fits.prepared, fitted_to, candidate, model, lacking, ())
    try:
        result = replace(result, warnings=(*fit_doubts(fits, candidate), *lacking))
        return replace(result, agreement=agreement(fitted_to, candidate.fit, fits.progress))
    except KeyboardInterrupt:
        return result.interrupted()


def rules_with(checks: Sequence[Path | str]) -> Rules:
    """The lab's limits with the user's own checks.  Raises InputError, FileNotFoundError."""
    return replace(DEFAULT_RULES, own=tuple(read_own_checks(checks, [c.name for c in CHECKS])))


def examined(fits: FitCache, rules: Rules = DEFAULT_RULES) -> Examination:
    """The diagnosis of a prepared study and its fits; if it is stopped, the results until then."""
    return with_strength(examine(fits.with_rules(rules)))


def diagnosed(examination: Examination, folder: Path, *, every_step: bool = True) -> DiagnoseResult:
    """The result of `cell.diagnose` from an examination: diagnosis, comparisons, next steps.

    folder      of the study, for the commands that it recommends
    every_step  compare the models with each effect added too, not only the first and the last
    """
    fits = examination.fits
    steps = [fits.prior_candidate(), *examination.path[1:]]
    shown = steps if every_step else [steps[0], *steps[1:][-1:]]
    in_model = fits.space.effects
    todo = advice(
        examination.diagnosis,
        Paths.of(folder, [*in_model, *fits.library.values()]),
        known=tuple(e.name for e in in_model),
        accepted=tuple(e.name for e in examination.accepted.effects if e not in in_model),
    )
    comparisons = _comparisons(fits, [c.fit.model for c in shown])
    if fits.work.spent:
        fits.work.conclude()  # for the page
    return DiagnoseResult(examination.diagnosis, comparisons, todo, examination)


def _comparisons(fits: FitCache, models: Sequence[CableModel]) -> tuple[Comparison, ...]:
    """Comparison of models with the trials; if stopped, initial states come from first frames."""
    study, work = fits.prepared.study, fits.work
    try:
        with work.stage("compare"):
            return tuple(compare_model(study, model, work=work) for model in models)
    except WorkStoppedError:
        work.conclude()
        return tuple(compare_model(study, model, work=work) for model in models)


def opened_study(study: StudyOrFolder) -> Study:
    """The checked study, without copies of its trials.  Raises InputError, ValueError."""
    if not isinstance(study, Study):
        return read_study(study)
    check_study(study)
    return without_copies(study)


def _place(study: StudyOrFolder) -> Path:
    """The study's folder as an argument of a command."""
    return Path("STUDY") if isinstance(study, Study) else Path(study)


def _model(entry: FitResult | Identified | Path | str, study: Study) -> Identified:
    if isinstance(entry, FitResult):
        entry = entry.model
    if isinstance(entry, Path | str):
        path, model = Path(entry), read_model(Path(entry), {})
    elif isinstance(entry, Identified):
        path, model = Path("model"), entry
    else:
        raise TypeError(f"models: {entry!r} is none; give a result of `cell.fit` or a model's file")
    check_same_kind(path, model, study.cable)
    return model


def _titles(
    sources: Sequence[FitResult | Identified | Path | str], models: Sequence[Identified]
) -> list[str]:
    """Distinct titles: names of files without suffix, else the effects in a model."""
    files = [Path(g) for g in sources if isinstance(g, Path | str)]
    of_files, titles = iter(model_names(files)), list[str]()
    for source, model in zip(sources, models, strict=True):
        effects = " + ".join(e.name for e in model.space.effects) or "baseline"
        name = next(of_files) if isinstance(source, Path | str) else effects
        numbers = (f"{name} ({n})" for n in range(2, len(sources) + 1))
        titles.append(next(n for n in (name, *numbers) if n not in titles))
    return titles
