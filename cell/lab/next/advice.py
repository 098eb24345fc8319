"""Next steps after a result of the lab, as commands that can be typed as printed."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from cell.cable.effects import Effect
from cell.lab.data.results import Diagnosis, Status, Verdict

#: What the verdicts of a diagnosis mean.
VERDICTS: dict[Verdict, str] = {
    "complete": "the residual is noise; these motions show no missing effect",
    "missing": "the effects named are missing in the model, confirmed on motions not fitted to",
    "unexplained": "the model lacks an effect, and no effect that was tried explains the error "
    "down to the noise",
    "cannot_tell": "these motions cannot decide whether the model lacks an effect, or which one; "
    "the checks that failed say why",
}
#: What the status of a single effect means.
STATUSES: dict[Status, str] = {
    "present": "missing in the model",
    "inspect": "explains a part too; examine it",
    "absent": "excluded at its typical size, given the model found",
    "cannot_tell": "possible given the model found; these trials could not show it",
}


def meaning(diagnosis: Diagnosis) -> str:
    """What the verdict of a diagnosis means."""
    if "not_searched" in diagnosis.codes:
        return "this is not a model of this cable, and no effect was looked for"
    if "noise_unknown" in diagnosis.codes and not diagnosis.missing:
        return "the noise is not known well enough to decide whether the model lacks an effect"
    if diagnosis.ended_early and not diagnosis.missing:
        return "the search was stopped before it could decide whether the model lacks an effect"
    return VERDICTS[diagnosis.verdict]


@dataclass(frozen=True)
class NextStep:
    """A suggested next step: why, and the command, if there is one."""

    why: str
    command: str = ""


#: Only step if the model's parameters are meaningless.
MEND = NextStep(
    "Correct the study first: signs and axes of its frame, gravity, the order of the markers, the "
    "datasheet, one clock for both files. The cable must be held at one end only."
)


REST = NextStep(
    "Record more frames at rest before each motion, or state the measurement's error as "
    "noise_std_m in study.yaml."
)


@dataclass(frozen=True)
class Paths:
    """Names of study and effect files for the command line.

    study    folder as the user gave it
    files    a user's own effects by name: path as the user gave it
    """

    study: Path = Path("STUDY")
    files: Mapping[str, Path] | None = None

    @staticmethod
    def of(study: Path, effects: Iterable[type[Effect]]) -> Paths:
        """Paths of a study and of the effects used with it."""
        own = {e.name: _shown(e.file.path) for e in effects if e.file is not None}
        return Paths(study, own)

    def options(self, effects: Iterable[str]) -> str:
        """`--with …` for effects by name or file, with a blank before each."""
        own = self.files or {}
        return "".join(f" --with {shlex.quote(str(own.get(e, e)))}" for e in effects)

    def command(self, name: str, effects: Iterable[str] = (), rest: str = "") -> str:
        """A lab command for the study."""
        study = shlex.quote(str(self.study))
        return f"cell {name} {study}{self.options(effects)}{' ' if rest else ''}{rest}"


def _shown(path: Path) -> Path:
    """A path relative to the current folder, if it is below that."""
    folder = Path.cwd()
    return path.relative_to(folder) if path.is_relative_to(folder) else path


def comparison_steps(
    paths: Paths, effects: Iterable[str], known: Iterable[str] = ()
) -> tuple[NextStep, ...]:
    """Commands that fit a model without and with effects, and compare the two."""
    arguments = "--model before.json --model after.json --report comparison.html"
    return (
        NextStep("Fit the model before", paths.command("fit", known, "-o before.json")),
        NextStep("Fit the model after", paths.command("fit", [*known, *effects], "-o after.json")),
        NextStep("Compare the errors of both", paths.command("compare", (), arguments)),
    )


def advice(
    diagnosis: Diagnosis,
    paths: Paths = Paths(),
    *,
    known: tuple[str, ...] = (),
    accepted: tuple[str, ...] = (),
) -> tuple[NextStep, ...]:
    """Next steps after a diagnosis; none with an effect that the diagnosis excludes.

    known     effects that were part of the model
    accepted  effects confirmed in the search, if no partial explanation has more
    """
    if diagnosis.codes & {"not_searched", "hopeless"}:
        return (MEND,)
    if "noise_unknown" in diagnosis.codes and not diagnosis.missing:
        return (REST,)
    missing = [f.effect for f in diagnosis.missing]
    ruled_out = {r.effect for r in diagnosis.ranking if r.status == "absent"}
    accepted = tuple(e for e in accepted if e not in ruled_out)
    motion = NextStep(
        "Find the motion that distinguishes them", paths.command("suggest", known, "-o motion.yaml")
    )
    match diagnosis.verdict:
        case "complete":
            return (NextStep("Nothing needs to be added."),)
        case "missing":
            tied = any(f.tied_with for f in diagnosis.missing)
            return (*comparison_steps(paths, missing, known), *([motion] if tied else []))
        case "unexplained":
            accepted = tuple(f.effect for f in diagnosis.partial) or accepted
            in_model = [*known, *accepted]
            addition = f" in addition to {' and '.join(in_model)}" if in_model else ""
            search = paths.command("discover", in_model, f"-o {_new_law(in_model)}.py")
            comparison = comparison_steps(paths, accepted, known) if accepted else ()
            return (*comparison, NextStep(f"Search for an unknown law{addition}", search))
        case _:
            return (NextStep("Measure more. " + motion.why, motion.command),)


def after_discovery(
    effect: str, complete: bool, paths: Paths, known: tuple[str, ...] = ()
) -> tuple[NextStep, ...]:
    """Next steps after the discovery of a law."""
    steps = comparison_steps(paths, [effect], known)
    if complete:
        return steps
    in_model = [*known, effect]
    command = paths.command("discover", in_model, f"-o {_new_law(in_model)}.py")
    return (*steps, NextStep("Search for what else is missing", command))


def _new_law(used: Iterable[str]) -> str:
    """A new name for a law."""
    names = itertools.chain(["discovered"], map("discovered_{}".format, itertools.count(2)))
    return next(itertools.filterfalse(set(used).__contains__, names))
