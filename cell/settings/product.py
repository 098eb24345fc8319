"""What the settings say of one product, and which product the id of a part means."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field, JsonValue

from cell.settings.section import Section

#: A product's name is part of files' names and of commands.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def pattern(text: str) -> str:
    """Validate a regular expression, and return it.  Raises ValueError."""
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"{text!r} is no pattern: {error}; A-\\d+ is one") from error
    return text


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


#: Sections in which a product replaces single entries, and what of them belongs to the cell.
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

    patterns  by the product's name; None = its parts are not known by their ids
    raises    ValueError: no pattern matches, or those of several products do
    """
    known = {name: said for name, said in patterns.items() if said is not None}
    found = [name for name, said in known.items() if re.fullmatch(said, part)]
    if len(found) > 1:
        raise ValueError(
            f"part {part!r} matches part_ids of {' and '.join(found)}; make the patterns narrower"
        )
    if known and not found:
        said = ", ".join(f"{name} '{said}'" for name, said in known.items())
        raise ValueError(
            f"part {part!r} matches part_ids of no product: {said}; name the product, or correct "
            "the id or a pattern"
        )
    return found[0] if found else None


def product_for(
    patterns: Mapping[str, str | None], asked: str | None, part: str | None, usual: str | None
) -> str | None:
    """Name of the product to make of a part; None = there are no products.

    patterns  as for `product_of_part`
    asked     by name; None = as the part's id says, else the usual one
    raises    ValueError: it is not said, or the id means another one than was asked for
    """
    if not patterns:
        return None
    if asked is not None and asked not in patterns:
        raise ValueError(f"{asked!r} is no product; those are {', '.join(patterns)}")
    told = None
    try:
        told = None if part is None else product_of_part(patterns, part)
    except ValueError:
        if asked is None:
            raise  # an id that means nothing does not gainsay a name
    if asked is not None and told not in (None, asked):
        raise ValueError(f"part {part!r} is of product {told}, not {asked}; look at the cable")
    found = asked or told or usual
    if found is None:
        raise ValueError(
            f"which product? give one of {', '.join(patterns)} by name or by the part's id, or "
            "name the usual one in the settings: `product: …`"
        )
    return found


def overlaid(whole: Mapping[str, Any], name: str, product: Mapping[str, Any]) -> dict[str, Any]:
    """Plain settings for a product: those of the file, overridden by the product's entries.

    whole    as in the file, or as `Settings` gives it
    product  its section, the same way
    """
    found = {key: value for key, value in whole.items() if key != "products"}
    for section in REPLACED:
        if product.get(section):
            found[section] = _merged(found.get(section) or {}, product[section])
    if product.get("model") is not None:
        found["model"] = product["model"]
    model = found.get("model") or {}
    if product.get("prior") is not None and (product.get("model") or {}).get("prior") is None:
        found["model"] = {**model, "prior": product["prior"]}
    if product.get("force_n") is not None:
        found["gripper"] = {**found["gripper"], "force_n": product["force_n"]}
    return {**found, "product": name}


def _merged(below: Any, above: Any) -> Any:
    """Mappings entry by entry; of anything else, and of `effects`, the one above."""
    if not isinstance(below, Mapping) or not isinstance(above, Mapping):
        return above
    entries = {
        key: value if key == "effects" else _merged(below.get(key), value)
        for key, value in above.items()
    }
    return {**below, **entries}
