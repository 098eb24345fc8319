"""Command that writes a cable's model for other programs; `cell fit --from` is the way back."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import folder_in, folder_of, taking
from cell.cli.lab import MovedEffect
from cell.cli.output import Json, JsonCommand, deliver_result, show
from cell.cli.shared import (
    BAD_INPUT,
    NOT_ALL_DONE,
    STDOUT,
    Force,
    group,
    refusing,
    tell_notes,
    working,
)
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.exchange.peer import PeerTrial
    from cell.identify.identified import Identified

app = group()


class Target(Enum):
    """Format that a model is exported to."""

    MUJOCO = "mujoco"
    JSON = "json"


def _model_file(ctx: typer.Context, path: Path) -> Path:
    """The file itself, or that of a cycle's folder or recording."""
    file = folder_in(ctx.with_resource, path)
    return file / "model.json" if file.is_dir() else file


@dataclass(frozen=True)
class ExportOptions:
    """Options of `cell export`."""

    model: Annotated[
        Path,
        typer.Argument(
            help="Model by `cell fit -o` or `cell identify -o`; or a cycle's folder or recording.",
            callback=_model_file,
        ),
    ]
    to: Annotated[Target, typer.Option("--to", help="MuJoCo's XML, or a plain description.")]
    out: Annotated[Path, typer.Option("-o", "--out", help="Write it to this file.")]
    links: Annotated[
        int | None,
        typer.Option(
            "--links",
            min=4,
            max=200,
            help="Links of the MuJoCo chain. Without: as few as keep the tip within 0.03 mm rms.",
        ),
    ] = None
    study: Annotated[
        Path | None,
        typer.Option(
            "--study",
            help="Compare in this study's or cycle's own motions too.",
            callback=folder_of,
        ),
    ] = None
    effect: MovedEffect = None
    samples: Annotated[
        int,
        typer.Option(
            "--samples",
            min=0,
            max=1000,
            help="Number of further cables, sampled from the distribution of the parameters: in "
            "the description, or each in a file of its own, OUT_001.xml and so on.",
        ),
    ] = 0
    as_json: Json = None
    force: Force = False

    @property
    def files(self) -> tuple[Path, ...]:
        """Output files: one, or one for each sample."""
        own = range(1, 1 + self.samples * (self.to is Target.MUJOCO))
        return (self.out, *(_sample_file(self.out, k) for k in own))


@app.command(cls=JsonCommand)
@taking(ExportOptions)
def export(options: ExportOptions) -> None:
    """Write a cable's model for another program, and print how far MuJoCo's tip is from the
    model's.

    Exit codes: 0; 1 if MuJoCo's tip is too far from the model's; 2 if the input is wrong.
    """
    from cell.lab.data.named_effects import select_effects
    from cell.lab.search.setup import read_model

    with refusing(*options.files, options.as_json, force=options.force):
        own = {n: e for name in options.effect or [] for n, e in select_effects([name]).own.items()}
        identified = read_model(options.model, own)
    if options.to is Target.JSON:
        if options.links is not None or options.study is not None:
            print("--links and --study are for --to mujoco; leave them out", file=sys.stderr)
            raise typer.Exit(BAD_INPUT)
        _describe(identified, options)
    else:
        _to_mujoco(identified, options)


def _sample_file(out: Path, number: int) -> Path:
    """File of a sample."""
    return out.with_name(f"{out.stem}_{number:03d}{out.suffix}")


def _describe(identified: Identified, options: ExportOptions) -> None:
    """Write the description; it is also the result that `--json` prints."""
    from cell.exchange.description import description

    data = description(identified, options.samples)
    deliver_result(data, (options.out, options.as_json), tuple)
    if options.as_json != STDOUT:
        show(f"written to {options.out}: {data['format']}")


def _to_mujoco(identified: Identified, options: ExportOptions) -> None:
    """Write the XML and say how far the tips are apart; ends with 1 beyond the bar."""
    from cell.cable.solver import LanesError
    from cell.exchange.export import export_parts, export_to_mujoco, sampled_xml
    from cell.files.atomic import write_atomic
    from cell.files.input_error import InputError

    model, files = options.model, options.files
    with refusing(options.as_json, force=True), working("export") as progress:
        trials = () if options.study is None else _motions(options.study, model, identified)
        progress("comparing with MuJoCo")
        try:
            done = export_to_mujoco(identified.model, model.name, options.links, trials)
            drawn = [identified.space.model(q) for q in identified.samples(len(files) - 1)]
            texts = [done.xml, *sampled_xml(done, drawn, model.name)]
        except LanesError as error:
            message = f"cannot be simulated: {error}; fit the model again"
            raise InputError.at(model, message) from error
    written = [
        (file, partial(write_atomic, content=text)) for file, text in zip(files, texts, strict=True)
    ]
    deliver_result(done.to_json(), [options.as_json], lambda: export_parts(done), *written)
    if options.as_json != STDOUT:
        more = f", and {counted(len(drawn), 'sample')} to {files[1]} …" if drawn else ""
        show(f"written to {files[0]}{more}")
    if not done.within_bar:
        raise typer.Exit(NOT_ALL_DONE)


def _motions(study: Path, model: Path, identified: Identified) -> tuple[PeerTrial, ...]:
    """Motions of a study of the same kind of cable; those that begin bent are reported."""
    from cell.exchange.peer import trials_of
    from cell.lab.search.setup import check_same_kind
    from cell.study.folder import read_study, study_folder

    measured = read_study(study_folder(study))
    check_same_kind(model, identified, measured.cable)
    trials, bent = trials_of(measured)
    if bent:
        tell_notes([f"not compared, because they begin bent: {', '.join(bent)}"])
    return trials
