"""Commands that bring a cable's model to other programs, and back: export, import-mujoco."""

from __future__ import annotations

import sys
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.delivery import deliver, json_files
from cell.cli.given import folder_of
from cell.cli.lab import refusing, show, working
from cell.cli.result_json import Json, JsonCommand, print_result
from cell.cli.shared import BAD_INPUT, NOT_ALL_DONE, group, tell_notes

if TYPE_CHECKING:
    from cell.exchange.peer import Trial
    from cell.identify.identified import Identified

app = group()


class Target(Enum):
    """What a model is exported to."""

    MUJOCO = "mujoco"
    JSON = "json"


def _maybe_folder_of(ctx: typer.Context, given: Path | None) -> Path | None:
    return None if given is None else folder_of(ctx, given)


Force = Annotated[
    bool, typer.Option("--force", help="Overwrite a file that this program did not write.")
]


@app.command(cls=JsonCommand)
def export(
    model: Annotated[
        Path,
        typer.Argument(help="Model by `cell fit -o` or `cell identify`, or a cycle's model.json."),
    ],
    to: Annotated[Target, typer.Option("--to", help="MuJoCo's XML, or a plain description.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Write it to this file.")],
    links: Annotated[
        int | None,
        typer.Option(
            "--links",
            min=4,
            max=200,
            help="Links of the MuJoCo chain. Without: as few as keep the tip within 0.03 mm rms.",
        ),
    ] = None,
    study: Annotated[
        Path | None,
        typer.Option(
            "--study",
            help="Compare in this study's or cycle's own motions too.",
            callback=_maybe_folder_of,
        ),
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect", help="The file.py of an effect in the model, if the file was moved."
        ),
    ] = None,
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Write a cable's model for another program, and say how far MuJoCo is from the model."""
    from cell.lab.data.selection import select_effects
    from cell.lab.fit.individual_model import read_model

    with refusing(out, as_json, force=force):
        own = {n: e for name in effect or [] for n, e in select_effects([name]).own.items()}
        identified = read_model(model, own)
    if to is Target.JSON:
        if links is not None or study is not None:
            print("--links and --study are for --to mujoco; leave them out", file=sys.stderr)
            raise typer.Exit(BAD_INPUT)
        _describe(identified, out, as_json)
    else:
        _to_mujoco(identified, model, out, links, study, as_json)


def _describe(identified: Identified, out: Path, as_json: Path | None) -> None:
    """Write the description; it is also the result that `--json` prints."""
    from cell.exchange.description import description

    data = description(identified)

    def printed() -> None:
        if print_result(data, as_json):
            show(f"written to {out}: {data['format']}")

    deliver(printed, *json_files(data, out, as_json))


def _to_mujoco(
    identified: Identified,
    model: Path,
    out: Path,
    links: int | None,
    study: Path | None,
    as_json: Path | None,
) -> None:
    """Write the XML and say how far the tips are apart; ends with 1 beyond the bar."""
    from cell.exchange.export import export_to_mujoco
    from cell.exchange.report import export_parts
    from cell.files.atomic import write_whole

    with refusing(), working("export") as progress:
        trials = [] if study is None else _trials(study, model, identified)
        progress("comparing with MuJoCo", 0, 1)
        done = export_to_mujoco(identified.model, model.name, links, trials)
    data = done.to_json()

    def printed() -> None:
        if print_result(data, as_json):
            show(*export_parts(done, out))

    deliver(printed, (out, partial(write_whole, content=done.xml)), *json_files(data, as_json))
    if not done.within_bar:
        raise typer.Exit(NOT_ALL_DONE)


def _trials(study: Path, model: Path, identified: Identified) -> list[Trial]:
    """The motions of a study of the same kind of cable; those that begin bent are left out."""
    from cell.exchange.peer import Trial
    from cell.lab.fit.individual_model import check_same_kind
    from cell.study.folder import read_study, study_folder

    measured = read_study(study_folder(study))
    check_same_kind(model, identified, measured.cable)
    bent = [t.name for t in measured.trials if t.bent]
    if bent:
        tell_notes([f"not compared, because they begin bent: {', '.join(bent)}"])
    return [
        Trial(
            t.name,
            t.grip,
            float(min(t.grip.t_s[0], t.markers.t_s[0]) if t.release_s is None else t.release_s),
            float(t.markers.t_s[-1]),
            t.release_s,
        )
        for t in measured.trials
        if not t.bent
    ]


@app.command("import-mujoco", cls=JsonCommand)
def import_mujoco(
    xml: Annotated[Path, typer.Argument(help="MJCF with one chain of hinges that have springs.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Write the model to this file.")],
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Read EI(s), exponent and viscosity of a MuJoCo chain, and write them as a model."""
    from cell.exchange.imported import import_mujoco as imported_from
    from cell.lab.report.model_tables import model_table

    with refusing(out, as_json, force=force):
        found = imported_from(xml)
    tell_notes(found.notes)
    data = found.model.to_dict()

    def printed() -> None:
        if print_result(data, as_json):
            show(
                model_table(found.model), "Nothing was measured: the intervals are a weak prior's."
            )

    deliver(printed, *json_files(data, out, as_json))
