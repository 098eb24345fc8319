"""Options of a command as frozen data: one field each, in place of a long list of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, fields
from inspect import Parameter, Signature
from typing import Any, get_type_hints


def taking(kind: type[Any]) -> Callable[[Callable[[Any], None]], Callable[..., None]]:
    """A command for typer that takes the fields of a frozen dataclass as its options.

    Every field is annotated as typer wants a parameter to be.
    """
    hints = get_type_hints(kind, include_extras=True)
    options = [
        Parameter(
            field.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(kind)
    ]

    def made(command: Callable[[Any], None]) -> Callable[..., None]:
        def called(**given: Any) -> None:
            command(kind(**given))

        called.__name__, called.__doc__ = command.__name__, command.__doc__
        called.__module__ = command.__module__
        called.__signature__ = Signature(options)  # type: ignore[attr-defined]
        called.__annotations__ = {o.name: o.annotation for o in options}
        return called

    return made
