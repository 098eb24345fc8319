"""Tasks of the lab's page, each as its commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cell.web.jobs import MOVING, JobTask
from cell.web.theme import N_
from cell.web.workspace import Workspace

#: File of the proposal of `cell import`, and of a study.
MAPPING, STUDY, PREVIEW = "import.yaml", "study.yaml", "preview.html"
#: Name of the model without further effects.
BASELINE = "baseline"
#: Tables of a simulated cable with an effect that the model lacks, and entries of its data sheet.
EXAMPLE = Path(__file__).parents[1] / "examples" / "cable_a"
_EXAMPLE_SHEET = {
    "--free-length": 0.1,
    "--line-density": 0.0074,
    "--width": 0.016,
    "--thickness": 0.0001,
}
#: Pages that commands write for a study, by their served name.
PAGES = ("look.html", "compare.html", "own.html", "diagnosis.html", PREVIEW)
_SHOWN = frozenset({0, 1})


@dataclass(frozen=True)
class Subject:
    """A study, or the recorded cycle that contains one; `name` is that of its folder."""

    name: str
    folder: Path
    is_cycle: bool = False

    @property
    def is_there(self) -> bool:
        """Whether there is a study, or a mapping from which it can be made."""
        return any((self.folder / name).exists() for name in (STUDY, MAPPING))

    @property
    def to_import(self) -> bool:
        """Whether there is a proposed mapping only, from which a study is to be made."""
        return not self.is_cycle and not (self.folder / STUDY).exists()


@dataclass(frozen=True)
class LabTasks:
    """Makes tasks of one workspace and one cell's settings."""

    workspace: Workspace
    config: Path

    def show_study(self, subject: Subject) -> JobTask:
        """Show a study before any fit."""
        out = self.workspace.results(subject.name)
        words = ("look", str(subject.folder), "-o", str(out / "look.html"))
        return JobTask(N_("Look"), subject.name, (words,), _SHOWN, out / "look.txt")

    def gather(self, cycles: Sequence[Path], name: str) -> JobTask:
        """Make a study of several cycles of one cable."""
        out = self.workspace.studies / name
        words = ("study", *map(str, cycles), "-o", str(out))
        return JobTask(
            N_("Gather"), name, (words, self.show_study(Subject(name, out)).commands[0]), _SHOWN
        )

    def make_example(self, name: str) -> JobTask:
        """Make the study of the example's tables."""
        out = self.workspace.studies / name
        sheet = (w for option, value in _EXAMPLE_SHEET.items() for w in (option, f"{value:g}"))
        tables = map(str, sorted(EXAMPLE.glob("*.csv")))
        words = ("import", *tables, "-o", str(out), *sheet, "--force")
        made = self.write_study(Subject(name, out))
        return JobTask(N_("Example"), name, (words, *made.commands), _SHOWN, made.log)

    def propose(
        self,
        upload: str,
        files: Sequence[str],
        gripper_logs: Sequence[str],
        stated: Mapping[str, float],
    ) -> JobTask:
        """Propose a mapping of uploaded tables.

        stated  data of the cable that the files lack: option of `cell import` → SI units
        """
        folder = self.workspace.uploads / upload
        logs = _each("--hand", [str(folder / name) for name in gripper_logs])
        options = (w for name, value in stated.items() for w in (name, f"{value:g}"))
        out = self.workspace.studies / upload
        paths = (str(folder / name) for name in files)
        words = ("import", *paths, *logs, "-o", str(out), *options, "--force")
        return JobTask(N_("Import"), upload, (words,), _SHOWN, out / "import.txt")

    def write_study(self, subject: Subject) -> JobTask:
        """Make the study that a mapping describes."""
        words = ("import", str(subject.folder / MAPPING))
        look = self.show_study(subject)
        return JobTask(
            N_("Make the study"), subject.name, (words, *look.commands), _SHOWN, look.log
        )

    def fit(self, subject: Subject, name: str, effects: Sequence[str], from_line: bool) -> JobTask:
        """Fit a model with these effects in it."""
        return JobTask(N_("Fit"), subject.name, (self._fit(subject, name, effects, from_line),))

    def compare(self, subject: Subject, models: Sequence[str], effects: Sequence[str]) -> JobTask:
        """Compare models, in this order, with every trial."""
        words = self._compare(subject, models, effects, "compare")
        log = self.workspace.results(subject.name) / "compare.txt"
        return JobTask(N_("Compare"), subject.name, (words,), log=log)

    def fit_own(self, subject: Subject, effect: str, shared: Sequence[str]) -> JobTask:
        """Fit the model with and without a typed effect, and compare both."""
        file = str(self.workspace.effects / f"{effect}.py")
        before = f"without_{effect}"  # which no effect is called whose model is fitted here
        commands = (
            self._fit(subject, before, shared, False),
            self._fit(subject, effect, (*shared, file), False),
            self._compare(subject, (before, effect), (), "own"),
        )
        log = self.workspace.results(subject.name) / "own.txt"
        return JobTask(N_("Fit the effect"), subject.name, commands, log=log)

    def diagnose(
        self, subject: Subject, tried: Sequence[str], known: Sequence[str], from_line: bool
    ) -> JobTask:
        """Find the effect that the model lacks."""
        out = self.workspace.results(subject.name)
        words = (
            *("diagnose", str(subject.folder), *_each("--try", tried)),
            *_each("--with", known),
            *self._line(from_line),
            *("-o", str(out / "diagnosis.json"), "--report", str(out / "diagnosis.html")),
        )
        return JobTask(N_("Diagnose"), subject.name, (words,), log=out / "diagnosis.txt")

    def suggest(self, subject: Subject, tried: Sequence[str], known: Sequence[str]) -> JobTask:
        """Suggest the most informative motion."""
        out = self.workspace.results(subject.name)
        words = (
            *("suggest", str(subject.folder), *_each("--try", tried)),
            *_each("--with", known),
            *(*self._line(True), "-o", str(out / "motion.yaml")),
        )
        return JobTask(N_("Suggest a motion"), subject.name, (words,), log=out / "suggest.txt")

    def discover(self, subject: Subject, name: str, shared: Sequence[str]) -> JobTask:
        """Infer a law from the residual, as an effect that can be edited."""
        out = str(self.workspace.effects / f"{name}.py")
        words = ("discover", str(subject.folder), *_each("--with", shared), "-o", out)
        log = self.workspace.results(subject.name) / "discover.txt"
        return JobTask(N_("Infer a law"), subject.name, (words,), log=log)

    def learn(self, name: str, cycles: Sequence[Path], ledger: str, own: Sequence[str]) -> JobTask:
        """Learn what the line's model lacks, by default from the ledger's cycles."""
        out = self.workspace.candidates / f"{name}.yaml"
        which = tuple(map(str, cycles)) or ("--runs", ledger)
        words = ("learn", *which, *self._line(True), *_each("--try", own), "-o", str(out))
        log = self.workspace.candidates / f"{name}.txt"
        return JobTask(N_("Learn"), name, (words,), _SHOWN, log)

    def promote(self, candidate: str) -> tuple[str, ...]:
        """Words of the command that promotes a candidate's model."""
        path = self.workspace.candidates / f"{candidate}.yaml"
        return ("promote", str(path), *self._line(True))

    def undo(self) -> tuple[str, ...]:
        """Words of the command that undoes the last promotion."""
        return ("promote", "--undo", *self._line(True))

    def replay(self, subject: Subject) -> JobTask:
        """Compute a recorded cycle again, and compare every number; 1 = something differs."""
        log = self.workspace.results(subject.name) / "replay.txt"
        return JobTask(N_("Replay"), subject.name, (("replay", str(subject.folder)),), _SHOWN, log)

    def measure(self, subject: Subject, runs: Path) -> JobTask:
        """Measure a cable with the suggested motion; the gripper moves."""
        motion = self.workspace.results(subject.name) / "motion.yaml"
        words = (MOVING, *self._line(True), "--motion", str(motion), "--runs", str(runs))
        return JobTask(N_("Measure"), subject.name, (words,), moves=True)

    def model(self, subject: Subject, name: str) -> Path:
        """File of a model fitted to a study."""
        return self.workspace.results(subject.name) / "models" / f"{name}.json"

    def _fit(
        self, subject: Subject, name: str, effects: Sequence[str], from_line: bool
    ) -> tuple[str, ...]:
        out = str(self.model(subject, name))
        options = (*_each("--with", effects), *self._line(from_line))
        return ("fit", str(subject.folder), *options, "-o", out)

    def _compare(
        self, subject: Subject, models: Sequence[str], effects: Sequence[str], name: str
    ) -> tuple[str, ...]:
        out = self.workspace.results(subject.name)
        paths = [str(self.model(subject, m)) for m in models]
        options = (*_each("--model", paths), *_each("--with", effects))
        files = ("-o", str(out / f"{name}.json"), "--report", str(out / f"{name}.html"))
        return ("compare", str(subject.folder), *options, *files)

    def _line(self, wanted: bool) -> tuple[str, ...]:
        return ("--config", str(self.config)) if wanted else ()


def page_file(workspace: Workspace, study: str, page: str) -> Path:
    """File of one of `PAGES`, which a command wrote for a study."""
    folder = workspace.studies / study if page == PREVIEW else workspace.results(study)
    return folder / page


def _each(option: str, values: Sequence[str]) -> tuple[str, ...]:
    return tuple(w for value in values for w in (option, value))
