"""Next steps after a result of the lab, as commands that can be typed as printed."""

from __future__ import annotations

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


#: Where no parameter of the model means anything, nothing is to be fitted or looked for.
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
        """Of a study and the effects that it was examined with."""
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
    """A path relative to where the user is, if it is below."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def comparison_steps(
    paths: Paths, effects: Iterable[str], known: Iterable[str] = ()
) -> tuple[NextStep, ...]:
    """Commands that fit a model without and with effects, and compare the two."""
    both = "--model before.json --model after.json --report comparison.html"
    return (
        NextStep("Fit the model before", paths.command("fit", known, "-o before.json")),
        NextStep("Fit the model after", paths.command("fit", [*known, *effects], "-o after.json")),
        NextStep("Compare the errors of both", paths.command("compare", (), both)),
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
    accepted  effects that were confirmed on the way; what explains most, if anything does, is more
    """
    if diagnosis.codes & {"not_searched", "hopeless"}:
        return (MEND,)
    if "noise_unknown" in diagnosis.codes and not diagnosis.missing:
        return (REST,)
    found = [f.effect for f in diagnosis.missing]
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
            return (*comparison_steps(paths, found, known), *([motion] if tied else []))
        case "unexplained":
            accepted = tuple(f.effect for f in diagnosis.partial) or accepted
            there = [*known, *accepted]
            addition = f" in addition to {' and '.join(there)}" if there else ""
            look = paths.command("discover", there, f"-o {_new_law(there)}.py")
            fall = comparison_steps(paths, accepted, known) if accepted else ()
            return (*fall, NextStep(f"Search for an unknown law{addition}", look))
        case _:
            return (NextStep("Measure more. " + motion.why, motion.command),)


def after_discovery(
    effect: str, complete: bool, paths: Paths, known: tuple[str, ...] = ()
) -> tuple[NextStep, ...]:
    """Next steps after the discovery of a law."""
    steps = comparison_steps(paths, [effect], known)
    if complete:
        return steps
    there = [*known, effect]
    more = paths.command("discover", there, f"-o {_new_law(there)}.py")
    return (*steps, NextStep("Search for what else is missing", more))


def _new_law(taken: Iterable[str]) -> str:
    """A name for a law that no effect has yet."""
    names, number = set(taken), 2
    if "discovered" not in names:
        return "discovered"
    while f"discovered_{number}" in names:
        number += 1
    return f"discovered_{number}"
