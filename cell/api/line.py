"""Learning as a function, `learn`: which effect the model of a line's cables lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from cell.api.lab import effect_names, several
from cell.api.results import Row, Shown
from cell.files.table import TableData
from cell.lab.data.cycles import read_cycles
from cell.lab.data.named_effects import select_effects
from cell.lab.data.work import Progress, no_progress
from cell.lab.line.candidate import Judgement, best_judged, lines_of, write_candidate
from cell.lab.line.effect_fit import LearningResult
from cell.lab.line.learn import learn as learn_from
from cell.lab.report.line_tables import common_error_line, learning_lines, learning_parts
from cell.settings import Settings
from cell.settings.loading import load_product
from cell.settings.translate import cable_of, identification_of


@dataclass(frozen=True, eq=False, repr=False)
class LearnResult(Shown):
    """The effect that a line's model lacks, by `cell.learn`.

    learned    the missing effects with their parameters, or that none is missing
    judgement  the gates of a candidate, with their statistics and limits
    settings   of the line
    left_out   cycles that could not be used, and why
    """

    learned: LearningResult
    judgement: Judgement
    settings: Settings
    left_out: tuple[str, ...]

    @property
    def fit_for_line(self) -> bool:
        """Whether there is a candidate that meets every condition."""
        return self.learned.best is not None and self.judgement.fit_for_line

    def parts(self) -> Sequence[str | TableData]:
        """Learned effects, their evidence, and the mean error of the forecasts."""
        common = common_error_line(self.judgement.paired)
        return (
            *learning_lines(self.learned),
            *learning_parts(self.learned, self.judgement.gates),
            *([common] if common else []),
        )

    def rows(self) -> list[Row]:
        """A row per cycle: its evidence for the effect, and its own estimate, SI units."""
        return [asdict(cycle) for cycle in self.learned.cycle_evidence]

    def write(self, path: Path | str) -> None:
        """Write the candidate for `cell promote`.  Raises ValueError: nothing is missing."""
        if self.learned.best is None:
            raise ValueError(f"{path}: nothing is missing, so there is no candidate to write")
        lines = lines_of(self.learned.cycles, self.settings)
        model, product = self.settings.model, self.settings.product
        write_candidate(Path(path), self.learned, self.judgement, model, lines, product)


def learn(
    runs: Sequence[Path | str],
    config: Path | str,
    *,
    product: str | None = None,
    effects: Sequence[Path | str] = (),
    progress: Progress = no_progress,
) -> LearnResult:
    """Find the effect that the line's model lacks, from recorded cycles of many cables.

    runs     folders of cycles, or folders of such folders
    config   settings of the line
    product  product of the cycles; None = the default one, or settings without products
    effects  files of your own effects, tried in addition to the library
    raises   InputError, ValueError: no cycle can be used, or settings or effects are wrong
    """
    settings = load_product(Path(config), product)
    cable, options = cable_of(settings), identification_of(settings)
    cycles, left_out = read_cycles([Path(run) for run in several(runs)], cable, settings.product)
    library = select_effects([], effect_names(effects)).candidates
    result = learn_from(cycles, cable, options, library, progress)
    return judged(result, settings, left_out)


def judged(result: LearningResult, settings: Settings, left_out: Sequence[str]) -> LearnResult:
    """The result of learning, tested by the gates of the line."""
    result, judgement = best_judged(result, settings)
    left_out = (*left_out, *result.cables_left_out, *result.left_out)
    return LearnResult(result, judgement, settings, left_out)
