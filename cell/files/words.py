"""Words that depend on a number, and numbers for people.

These have SI prefixes; percentages are rounded to neither 0 nor 100 %.
"""

from __future__ import annotations

import re
from collections.abc import Sequence


def counted(number: int, singular: str, several: str | None = None) -> str:
    """`1 picture`, `2 pictures`: a number with its noun.

    several  None = `singular` with an s
    """
    return f"{number} {singular if number == 1 else several or f'{singular}s'}"


def error_text(error: BaseException) -> str:
    """`ValueError: too large`: kind and message of an exception; the kind alone if it has none."""
    return f"{type(error).__name__}: {error}".removesuffix(": ")


def first_of(texts: Sequence[str], most: int, joint: str = ", ") -> str:
    """The first `most` texts, joined, and the number of the others."""
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return f"{joint.join(texts[:most])}{more}"


#: Base unit that can have a prefix: the first of a unit, without a power.
_PREFIXED = re.compile(r"(kg|g|N|m|s|rad|Hz|Pa|J|W)(?![\w²³⁴^])")
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
#: Numbers between these need no prefix.
_LEAST, _MOST = 0.1, 1e4
#: A share beyond this is not rounded to all or nothing.
_NEARLY_ALL = 0.999


def with_prefix(values: Sequence[float], unit: str) -> tuple[list[str], str]:
    """Values with four digits, and their unit with the SI prefix that the largest needs."""
    largest = max((abs(v) for v in values), default=0.0)
    matched = _PREFIXED.match(unit)
    if matched is None or not 0.0 < largest < float("inf") or _LEAST <= largest < _MOST:
        return [f"{v:.4g}" for v in values], unit
    base, scale = (matched[1], 1.0) if matched[1] != "kg" else ("g", 1e3)
    fitting = [e for e in _PREFIXES if largest * scale >= 10.0**e]
    exponent = max(fitting, default=min(_PREFIXES))
    shown = [f"{v * scale / 10.0**exponent:.4g}" for v in values]
    return shown, _PREFIXES[exponent] + base + unit[matched.end() :]


def percent(share: float) -> str:
    """A share in percent, one decimal, without sign; 100.0 and 0.0 only for all and none."""
    if _NEARLY_ALL < share < 1.0:
        return f"> {_NEARLY_ALL:.1%}".removesuffix("%")
    if 0.0 < share < 1.0 - _NEARLY_ALL:
        return f"< {1.0 - _NEARLY_ALL:.1%}".removesuffix("%")
    return f"{100.0 * share:.1f}"
