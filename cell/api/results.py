"""Results of the lab's commands: shown in a notebook, written as the commands write them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.atomic import write_atomic
from cell.files.plain import plain
from cell.files.table import TableData
from cell.identify.identified import Identified
from cell.lab.data.results import (
    Agreement,
    Diagnosis,
    Doubt,
    to_json,
    write_json,
)
from cell.lab.report.model_tables import (
    comparison_sentence,
    comparison_table,
    comparisons_table,
    correlations_table,
    errors_line,
    model_table,
    power_sentences,
    power_table,
    recovery_table,
    suggestion_table,
)
from cell.lab.report.tables import agreement_table, diagnosis_parts, knots_lines, warning_lines
from cell.lab.report.wording import agreement_sentence, by_evidence
from cell.lab.report.wrench_report import wrenches_table
from cell.lab.strength.compare import Comparison, comparisons_json
from cell.lab.strength.estimate import identified
from cell.lab.verdict.doubts import ended_doubt
from cell.study.wrench import COLUMNS
from drivers.installing import install_extra

if TYPE_CHECKING:
    import pandas as pd


#: A row of a data frame by its columns.
Row = dict[str, Any]


class Shown:
    """A result: sentences and tables for people, plain data and rows for programs."""

    def parts(self) -> Sequence[str | TableData]:
        """What the command prints, in its order."""
        raise NotImplementedError

    def rows(self) -> list[Row]:
        """The main table, one entry per column."""
        raise NotImplementedError

    def to_frame(self) -> pd.DataFrame:
        """The main table as a data frame, numbers in SI units.

        raises  ImportError: pandas is not installed
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError(
                f"data frames need pandas; install it with: {install_extra('notebook')}"
            ) from error
        return pd.DataFrame.from_records(self.rows())

    def __repr__(self) -> str:
        """The first sentence that the command prints."""
        sentences = [part for part in self.parts() if isinstance(part, str)]
        first = sentences[0] if sentences else self.parts()[0]
        return f"<{type(self).__name__}: {first if isinstance(first, str) else first.title}>"

    def _repr_html_(self) -> str:
        """HTML for a notebook."""
        from cell.files.page import fragment  # templates: not needed without a notebook

        return fragment(self.parts())


if TYPE_CHECKING:
    from cell.lab.data.prepared import PreparedStudy
    from cell.lab.next.advice import NextStep
    from cell.lab.next.motion_file import Suggestion
    from cell.lab.next.study_power import StudyPower
    from cell.lab.search.fitted_model import FittedModel
    from cell.lab.verdict.conclusion import Examination


@dataclass(frozen=True, eq=False, repr=False)
class FitResult(Shown):
    """A model fitted to a study, by `cell.fit`.

    prepared   the prepared study
    reestimated  the same with re-estimated noise, as in the final fit
    candidate  the fit: its `errors` are root mean square per coordinate, fitted and held out, m
    model      parameters with their 95 % intervals, in SI units
    warnings   reasons to doubt it
    agreement  estimates of the parameters per trial
    """

    prepared: PreparedStudy
    reestimated: PreparedStudy
    candidate: FittedModel
    model: Identified
    warnings: tuple[Doubt, ...]
    agreement: tuple[Agreement, ...]

    def interrupted(self) -> FitResult:
        """The same with a warning that the computation was interrupted."""
        doubt = ended_doubt(False, "the computations after the fit are missing or incomplete")
        warnings = (w for w in self.warnings if w.code != doubt.code)
        return replace(self, warnings=(doubt, *warnings))

    def parts(self) -> Sequence[str | TableData]:
        """Warnings, the error, the parameters, and the agreement of the trials."""
        apart: tuple[str | TableData, ...] = ()
        if self.agreement:
            apart = agreement_sentence(self.agreement), agreement_table(self.agreement)
        error = errors_line(self.prepared, self.candidate.errors)
        knots = knots_lines(self.model.space.knots)
        table = model_table(self.model, "the fit trials")
        return (*warning_lines(self.warnings), error, *knots, table, *apart)

    def to_json(self) -> dict[str, Any]:
        """As `cell fit -o` writes it (identified-cable/1)."""
        return self.model.to_dict() | {
            "warnings": [vars(w) for w in self.warnings],
            "agreement": [plain(asdict(a)) for a in self.agreement],
        }

    def rows(self) -> list[Row]:
        """A row per parameter: name, value, low, high, unit."""
        low, high = self.model.interval()
        names = ("parameter", "value", "low", "high", "unit")
        columns = (self.model.space.names, self.model.values, low, high, self.model.space.units)
        return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]

    def write(self, path: Path | str) -> None:
        """Write the model as JSON, which `cell compare --model` and `--prior` read."""
        write_json(self.to_json(), Path(path))


@dataclass(frozen=True, eq=False, repr=False)
class CompareResult(Shown):
    """Models compared with the measurements, by `cell.compare`, in the order of the arguments."""

    comparisons: tuple[Comparison, ...]

    def parts(self) -> Sequence[str | TableData]:
        """Errors of the models, then the map of errors of the last one."""
        last = self.comparisons[-1]
        several = len(self.comparisons) > 1
        side_by_side = [comparisons_table(self.comparisons)] if several else []
        wrenches = wrenches_table(self.comparisons)
        tables = comparison_table(last), *([wrenches] if wrenches else []), correlations_table(last)
        return (comparison_sentence(self.comparisons), *side_by_side, *tables)

    def to_json(self) -> dict[str, Any]:
        """As `cell compare -o` writes it (cable-comparison/1)."""
        return comparisons_json(self.comparisons)

    def rows(self) -> list[Row]:
        """A row per model and trial: rms error per coordinate, m, and p-value of whiteness."""
        return [
            {
                "model": c.model,
                "trial": trial.name,
                "role": trial.role,
                "rms_m": where.rms_m,
                "whiteness_p_value": where.whiteness_p_value,
            }
            for c in self.comparisons
            for trial, where in zip(c.study.trials, c.where, strict=True)
        ]

    def predicted_m(self, model: int = -1) -> dict[str, FloatArray]:
        """Markers of each trial as one of the models predicts them: (times, markers, 2), m.

        At the times of `study.trials[…].markers.t_s`, markers in the order of `study.arc_length_m`
        """
        return dict(self.comparisons[model].predicted_m)

    def residuals_m(self, model: int = -1) -> dict[str, FloatArray]:
        """Measured − predicted of one of the models by trial: (times, markers, 2), m.

        nan where a marker was not detected
        """
        predicted, trials = self.predicted_m(model), self.comparisons[model].study.trials
        return {t.name: t.markers.xy_m - predicted[t.name] for t in trials}

    def write_residuals(self, folder: Path | str) -> list[Path]:
        """Write residuals as CSV, `MODEL/TRIAL.csv`: t_s, then dx and dy of each marker, m.

        For a wrench `MODEL/TRIAL_wrench.csv`: t_s, then force x, y, N, and moment, N·m, minus the
        maximum-likelihood tare.

        returns  the files written
        """
        written = []
        for number, residual in enumerate(self.comparisons):
            for trial in residual.study.trials:
                count = trial.markers.xy_m.shape[1]
                heads = ["t_s", *(f"d{axis}{m}_m" for m in range(count) for axis in "xy")]
                residual_m = self.residuals_m(number)[trial.name].reshape(-1, 2 * count)
                rows = np.column_stack([trial.markers.t_s, residual_m])
                path = Path(folder) / residual.model.replace("/", "_") / f"{trial.name}.csv"
                written.append(_write_csv(path, heads, rows))
            for w in residual.wrenches:
                rows = np.column_stack([w.t_s, w.measured - w.predicted])
                path = Path(folder) / residual.model.replace("/", "_") / f"{w.trial}_wrench.csv"
                written.append(_write_csv(path, ["t_s", *COLUMNS], rows))
        return written


def _write_csv(path: Path, heads: Sequence[str], rows: FloatArray) -> Path:
    lines = [",".join(heads), *(_csv_row(row) for row in rows)]
    write_atomic(path, "\n".join(lines) + "\n")
    return path


def _csv_row(row: FloatArray) -> str:
    """Numbers to the last bit; missing ones stay empty."""
    return ",".join("" if np.isnan(v) else repr(float(v)) for v in row)


@dataclass(frozen=True, eq=False, repr=False)
class DiagnoseResult(Shown):
    """Which effect a model lacks, by `cell.diagnose`.

    diagnosis    verdict, effects with intervals, every check with its statistic and limit
    comparisons  of the initial model, and last of the model with all detected effects
    todo         what to do next
    examination  the underlying fits
    """

    diagnosis: Diagnosis
    comparisons: tuple[Comparison, ...]
    todo: tuple[NextStep, ...]
    examination: Examination

    @cached_property
    def model(self) -> Identified:
        """The model with all detected effects, and its parameters' intervals."""
        fits = self.examination.fits
        return identified(fits.prepared, self.examination.path[-1].fit, fits.library.values())

    def parts(self) -> Sequence[str | TableData]:
        """The verdict, then its evidence."""
        return diagnosis_parts(self.diagnosis, self.comparisons, self.todo)

    def to_json(self) -> dict[str, Any]:
        """As `cell diagnose -o` writes it (cable-diagnosis/1)."""
        return to_json(self.diagnosis)

    def rows(self) -> list[Row]:
        """A row per tested effect, the likeliest first, and its place in the verdict."""
        diagnosis, places = self.diagnosis, dict[str, str]()
        for place, effects in (("partial", diagnosis.partial), ("missing", diagnosis.missing)):
            for effect in effects:
                places |= {effect.effect: place} | dict.fromkeys(effect.tied_with, f"tied: {place}")
        return [{**asdict(r), "answer": places.get(r.effect, "")} for r in by_evidence(diagnosis)]

    def write_report(self, path: Path | str) -> None:
        """Write the HTML page of `cell diagnose --report`."""
        from cell.files.page import write_page
        from cell.lab.report.report import diagnosis_page

        page = diagnosis_page(self.diagnosis, self.comparisons, self.model, self.todo)
        write_page(page, Path(path))


@dataclass(frozen=True, eq=False, repr=False)
class PowerResult(Shown):
    """Forecast of what a diagnosis of a study would detect, by `cell.power`."""

    power: StudyPower

    def parts(self) -> Sequence[str | TableData]:
        """Detectable effects, the forecast, and the detections in copies if there are any."""
        copies = recovery_table(self.power)
        return (
            *power_sentences(self.power),
            *warning_lines(self.power.warnings),
            power_table(self.power),
            *([] if copies is None else [copies]),
        )

    def to_json(self) -> dict[str, Any]:
        """As `cell power --json` prints it (cable-power/1)."""
        return self.power.to_json()

    def rows(self) -> list[Row]:
        """A row per effect: its size, the probability of detection, and the smallest size."""
        return [
            {
                "effect": forecast.query.effect.name,
                "parameter": forecast.query.parameter.name,
                "size": forecast.size,
                "unit": forecast.query.parameter.unit,
                "found": None if forecast.chances is None else forecast.chances.found,
                "smallest": forecast.smallest,
            }
            for forecast in self.power.effects
        ]


@dataclass(frozen=True, eq=False, repr=False)
class SuggestResult(Shown):
    """The motions that distinguish the candidates best, by `cell.suggest`."""

    suggestion: Suggestion

    def parts(self) -> Sequence[str | TableData]:
        """What the present trials separate, then the motions, the best first."""
        suggestion = self.suggestion
        already = [f"{suggestion.separated_text()}."] if suggestion.separated else []
        return (*already, suggestion_table(suggestion))

    def to_json(self) -> dict[str, Any]:
        """As `cell suggest --json` prints it (cable-suggestion/1)."""
        return self.suggestion.to_json()

    def rows(self) -> list[Row]:
        """A row per motion: places, m, angles, rad, durations, s, and its power."""
        return [dict(option) for option in self.to_json()["options"]]

    def write(self, path: Path | str) -> None:
        """Write the best motion as a file for `cell run --motion`."""
        from cell.lab.next.motion_file import write_motion  # settings: a fifth of a second

        write_motion(self.suggestion, Path(path))
