"""One meaning of --json and -o in every command: --json prints the result, -o writes it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from cell.cli.streams import emit

#: Stands for the standard output where a file could be given.
STDOUT = Path("-")

Json = Annotated[
    Path | None,
    typer.Option(
        "--json",
        help="Print the result as JSON instead of tables. (Older form: --json FILE writes it.)",
        show_default=False,
        metavar="",
    ),
]


class JsonCommand(TyperCommand):
    """Command whose `--json` prints, and whose `--json FILE`, the older form, writes.

    A word after `--json` is a file unless a required argument would be missing without it.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give every bare `--json` the standard output for its file."""
        for i, word in reversed(list(enumerate(args))):
            following = args[i + 1] if i + 1 < len(args) else "--"
            if word == "--json" and (
                (following.startswith("-") and following != str(STDOUT))
                or not self.is_complete(self._given(ctx, [*args[:i], *args[i + 2 :]]))
            ):
                args = [*args[: i + 1], str(STDOUT), *args[i + 1 :]]
        return super().parse_args(ctx, args)

    def is_complete(self, given: Mapping[str, Any]) -> bool:
        """Whether every required argument has a value; `given` has the words by parameter."""
        return all(
            isinstance(given.get(str(parameter.name)), str | tuple | list)
            for parameter in self.params
            if parameter.param_type_name == "argument" and parameter.required
        )

    def _given(self, ctx: Any, args: list[str]) -> Mapping[str, Any]:
        given: Mapping[str, Any] = self.make_parser(ctx).parse_args(list(args))[0]
        return given


def print_result(data: dict[str, Any], *places: Path | None) -> bool:
    """Print a result as JSON if that is asked for; returns whether tables are wanted instead."""
    if STDOUT not in places:
        return True
    emit(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False))
    return False
