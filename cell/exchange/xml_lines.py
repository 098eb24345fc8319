"""In which lines of an XML file its elements stand."""

from __future__ import annotations

import re
from contextlib import suppress
from xml.parsers import expat

#: Elements that are joints.
_JOINTS = ("joint", "freejoint")


def element_lines(text: str) -> dict[tuple[str, str], int]:
    """Lines, from 1, by element and name ('' without one); joints of bodies also by number.

    A joint's number is that in document order, as MuJoCo numbers them: ('#joint', '0').  What
    stands after a mistake has no lines.
    """
    found: dict[tuple[str, str], int] = {}
    open_elements: list[str] = []
    count = 0

    def start(element: str, attributes: dict[str, str]) -> None:
        nonlocal count
        line = parser.CurrentLineNumber
        inside_body = bool(open_elements) and open_elements[-1] in ("body", "worldbody")
        if element not in _JOINTS or inside_body:
            found.setdefault((element, attributes.get("name", "")), line)
        if element in _JOINTS and inside_body:
            found[("#joint", str(count))] = line
            count += 1
        open_elements.append(element)

    def end(element: str) -> None:
        open_elements.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    with suppress(expat.ExpatError):
        parser.Parse(text, True)
    return found


def line_in(message: str) -> int:
    """The line that a message of MuJoCo's names; 1 if it names none."""
    named = re.search(r"\bline(?: number)?[ :=]+(\d+)", message, re.IGNORECASE)
    return int(named[1]) if named else 1
