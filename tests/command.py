"""A command of `cell` in this process, where its start is not what is tested."""

from __future__ import annotations

from click.testing import Result
from typer.testing import CliRunner

from cell.cli import app


def run_cell(*words: object, code: int = 0) -> Result:
    """What a command prints, which must end with `code`."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == code, (done.exception, done.output)
    return done
