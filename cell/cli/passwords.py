"""A password that is typed."""

from __future__ import annotations

import sys

import typer


def typed_password() -> str:
    """Asked for twice at a terminal; elsewhere the first line of the standard input."""
    if sys.stdin.isatty():
        return str(typer.prompt("Password", hide_input=True, confirmation_prompt=True))
    return sys.stdin.readline().rstrip("\r\n")
