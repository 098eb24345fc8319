"""Section of the settings for one product, and the product of a part's id."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from re import _parser  # type: ignore[attr-defined]
from typing import Annotated, Any

from pydantic import AfterValidator, Field, JsonValue

from cell.settings.section import Section

#: A product's name is part of files' names and of commands.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


#: Limit of the ways in which a pattern may match: backtracking tries them all in a second or two.
_MOST_WAYS = 10**8
#: Counts of a repeat without an end; k of them split an id of 200 characters in some 100^k ways.
_OPEN_ENDED = 100


def pattern(text: str) -> str:
    """Validate a regular expression, and return it.  Raises ValueError."""
    try:
        re.compile(text)
        ways = _ways(_parser.parse(text))
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"'{text}' is no pattern: {error}; A-\\d+ is one") from error
    if ways > _MOST_WAYS:
        raise ValueError(
            f"'{text}' can match an id in more than {_MOST_WAYS:.0e} ways, which takes too long; "
            "give no repeat within a repeat, and limit repeats, as in [A-Z]{1,3}-\\d{1,6}"
        )
    return text


def _ways(parsed: Iterable[tuple[Any, Any]]) -> int:
    """Bound of the ways in which a parsed pattern can match, at most `_MOST_WAYS` + 1."""
    ways = 1
    for kind, what in parsed:
        parts = what if isinstance(what, tuple) else (what,)
        if kind is _parser.BRANCH:
            parts = tuple(what[1])
        inner = [_ways(part) for part in parts if isinstance(part, _parser.SubPattern)]
        if "REPEAT" in str(kind):
            low, high = (min(int(count), _OPEN_ENDED) for count in what[:2])
            ways *= sum(inner[0] ** count for count in range(low, high + 1))
        elif inner:  # alternatives, or one part
            ways *= sum(inner)
        ways = min(ways, _MOST_WAYS + 1)
    return ways


Overlay = dict[str, JsonValue]


class Product(Section):
    """What a product has otherwise than the rest of the file says.

    In `cable`, `destination`, `motion`, `vision`, `choice` and `world` single entries are replaced;
    `model` and `prior` are taken whole."""

    cable: Overlay = Field(default={})
    """Data sheet of its cable."""
    destination: Overlay = Field(default={})
    """Where its tip must pass."""
    motion: Overlay = Field(default={})
    """What the gripper does with it."""
    vision: Overlay = Field(default={})
    """What its cable looks like; the jaw is that of the cell."""
    choice: Overlay = Field(default={})
    """When an offset is good enough for it."""
    world: Overlay = Field(default={})
    """Its simulated cables; camera and arm are those of the cell."""
    model: dict[str, JsonValue] | None = None
    """What its cables have in common.  Null = as the section `model` of the file."""
    prior: dict[str, JsonValue] | None = None
    """Prior of its model, unless `model` has one.  Null = none."""
    force_n: Annotated[float, Field(gt=0.0)] | None = None
    """Force with which the jaws close on its cable. Null = `gripper.force_n`."""
    part_ids: Annotated[str, AfterValidator(pattern)] | None = None
    """Regular expression that the whole id of one of its parts must match, such as `A-\\d+`.
    Null = its parts are not known by their ids."""


#: Sections in which a product replaces single entries, and their entries that belong to the cell.
REPLACED: Mapping[str, tuple[str, ...]] = {
    "cable": (),
    "destination": (),
    "motion": (),
    "vision": ("jaw", "cable_is"),
    "choice": (),
    "world": ("camera", "arm_lag_s", "real_time_factor"),
}


def named(products: dict[str, Product]) -> dict[str, Product]:
    """Validate the names of products, and return the products.  Raises ValueError."""
    for name in products:
        if NAME.fullmatch(name) is None:
            raise ValueError(
                f"{name!r} can be no product's name; give letters, digits, '_', '-' and '.', at "
                "most 64, beginning with a letter or digit"
            )
    return products


Products = Annotated[dict[str, Product], AfterValidator(named)]


def product_of_part(patterns: Mapping[str, str | None], part: str) -> str | None:
    """Name of the product whose pattern the id of a part matches; None = no product has a pattern.

    patterns  by the product's name; None = the ids of its parts are not restricted
    raises    ValueError: no pattern matches, or those of several products do
    """
    known = {name: regex for name, regex in patterns.items() if regex is not None}
    matches = [name for name, regex in known.items() if re.fullmatch(regex, part)]
    if len(matches) > 1:
        raise ValueError(
            f"part {part!r} matches part_ids of {' and '.join(matches)}; make the patterns narrower"
        )
    if known and not matches:
        regex = ", ".join(f"{name} '{regex}'" for name, regex in known.items())
        raise ValueError(
            f"part {part!r} matches part_ids of no product: {regex}; name the product, or correct "
            "the id or a pattern"
        )
    return matches[0] if matches else None


def product_for(
    patterns: Mapping[str, str | None], requested: str | None, part: str | None, usual: str | None
) -> str | None:
    """Name of the product to make of a part; None = there are no products.

    patterns   as for `product_of_part`
    requested  name; None = by the part's id, else the default
    raises     ValueError: it is not determined, or the id contradicts the requested name
    """
    if not patterns:
        return None
    if requested is not None and requested not in patterns:
        raise ValueError(f"{requested!r} is no product; those are {', '.join(patterns)}")
    by_id = None
    try:
        by_id = None if part is None else product_of_part(patterns, part)
    except ValueError:
        if requested is None:
            raise  # an id that means nothing does not gainsay a name
    if requested is not None and by_id not in (None, requested):
        raise ValueError(f"part {part!r} is of product {by_id}, not {requested}; look at the cable")
    product = requested or by_id or usual
    if product is None:
        raise ValueError(
            f"which product? give one of {', '.join(patterns)} by name or by the part's id, or "
            "name the usual one in the settings: `product: …`"
        )
    return product


def overlaid(base: Mapping[str, Any], name: str, product: Mapping[str, Any]) -> dict[str, Any]:
    """Plain settings for a product: those of the file, overridden by the product's entries.

    base     as in the file, or as `Settings` gives it
    product  its section, the same way
    """
    settings = {key: value for key, value in base.items() if key != "products"}
    for section in REPLACED:
        if product.get(section):
            settings[section] = _merge(settings.get(section) or {}, product[section])
    if product.get("model") is not None:
        settings["model"] = product["model"]
    model = settings.get("model") or {}
    if product.get("prior") is not None and (product.get("model") or {}).get("prior") is None:
        settings["model"] = {**model, "prior": product["prior"]}
    if product.get("force_n") is not None:
        settings["gripper"] = {**settings["gripper"], "force_n": product["force_n"]}
    return {**settings, "product": name}


def _merge(below: Any, above: Any) -> Any:
    """Merge of mappings entry by entry; other data, and `effects`, are replaced by `above`."""
    if not isinstance(below, Mapping) or not isinstance(above, Mapping):
        return above
    entries = {
        key: value if key == "effects" else _merge(below.get(key), value)
        for key, value in above.items()
    }
    return {**below, **entries}
