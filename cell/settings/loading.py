"""Loads settings from a file, as written or for one of its products."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cell.files.input_error import InputError, Problem, did_you_mean
from cell.files.yaml_document import Complaint, Document, Key, dotted, read_yaml
from cell.settings.check import contradictions
from cell.settings.model import Settings
from cell.settings.plugged import validated
from cell.settings.product import REPLACED, overlaid

_PRODUCTS = "products"
#: Place of an entry of a product in the resulting settings, if under a different name.
_ELSEWHERE: Mapping[str, Key] = {"prior": ("model", "prior"), "force_n": ("gripper", "force_n")}


def load_settings(path: Path) -> Settings:
    """Settings from a YAML file; those of its products are checked too.

    raises  InputError: every mistake, each with file, line, column, key, value, limit, remedy
    """
    return settings_of(read_yaml(path))


def settings_of(document: Document) -> Settings:
    """Settings from a parsed file.  Raises InputError as `load_settings`."""
    settings = _with_files(validated(document), document.path)
    problems = [*contradictions(document, settings), *document.problems(_of_products(settings))]
    if problems:
        raise InputError(problems)
    made = {}
    for name, product in settings.products.items():
        try:
            complete = _checked_product(document, name)
        except InputError as error:
            problems += error.problems
            continue
        if product.model is not None:  # its files as absolute paths, too
            model = complete.model.model_dump(mode="json", exclude_unset=True)
            product = product.model_copy(update={"model": model})
        made[name] = product
    if problems:
        raise InputError(problems)
    return settings.model_copy(update={_PRODUCTS: made}) if made else settings


def load_product(path: Path, name: str | None) -> Settings:
    """Settings from a YAML file, for a product.

    name    of the product; None = the file's default product, or a file without products
    raises  InputError: as `load_settings`; there is no such product; there is no default
    """
    settings = load_settings(path)
    wanted = name or settings.product
    if not settings.products and name is None:
        return settings
    if wanted is None:
        known = ", ".join(settings.products)
        message = f"has {known}; say which one with --product, or name the usual one: `product: …`"
        raise InputError.at(path, message, key=_PRODUCTS)
    try:
        return for_product(settings, wanted)
    except ValueError as error:
        raise InputError.at(path, str(error), key=_PRODUCTS) from error


def for_product(settings: Settings, name: str) -> Settings:
    """The settings for a product, with its name and without other products.

    raises  ValueError: there is no such product
    """
    if name not in settings.products:
        known = ", ".join(settings.products) or "none"
        raise ValueError(f"{name!r} is no product of these settings; those are: {known}")
    plain = settings.model_dump(mode="json", exclude_unset=True)
    data = overlaid(plain, name, plain[_PRODUCTS][name])
    return type(settings).model_validate_json(json.dumps(data), strict=True)


def products_of(settings: Settings) -> dict[str, Settings]:
    """The settings of every product, in the order of the file."""
    return {name: for_product(settings, name) for name in settings.products}


@dataclass(frozen=True)
class _ProductDocument(Document):
    """The file with the entries of a product.

    own  entries of the product: key in its settings → key in the file
    """

    name: str = ""
    own: Mapping[Key, Key] = field(default_factory=dict)

    def problem(self, key: Key, message: str) -> Problem:
        """A problem as of the file; outside the product's section its message names the product."""
        present = key
        while present not in self.places:
            present = present[:-1]
        if present in self.own:
            key = (*self.own[present], *key[len(present) :])
        else:
            message = f"with product {self.name}: {message}"
        return Problem(self.path, *self.places[present], dotted(key), message)


def _checked_product(document: Document, name: str) -> Settings:
    """The settings of a product that is in the file.  Raises InputError."""
    made = _product_document(document, name)
    settings = _with_files(validated(made), document.path)
    if problems := contradictions(made, settings):
        raise InputError(problems)
    return settings


def _product_document(document: Document, name: str) -> _ProductDocument:
    section = document.data[_PRODUCTS][name] or {}
    data = overlaid(document.data, name, section)
    hidden = [(_PRODUCTS,), *((("model",),) if section.get("model") is not None else ())]
    places = {k: v for k, v in document.places.items() if k[:1] not in hidden}
    own: dict[Key, Key] = {}
    for key, place in document.places.items():
        if key[:2] != (_PRODUCTS, name) or len(key) < 3:
            continue
        at = (*_ELSEWHERE.get(str(key[2]), (key[2],)), *key[3:])
        own[at] = key
        places[at] = place
        if at[:1] not in places:  # the section stands only here
            own[at[:1]], places[at[:1]] = key[:2], place
    return _ProductDocument(document.path, data, places, name, own)


def _of_products(settings: Settings) -> Iterator[Complaint]:
    """Mistakes of the products as a group."""
    patterns: dict[str, str] = {}
    for name, product in settings.products.items():
        place: Key = (_PRODUCTS, name)
        for section, theirs in REPLACED.items():
            for entry in theirs:
                if entry in getattr(product, section):
                    message = f"belongs to the cell; write it in the section {section!r} of all"
                    yield (*place, section, entry), message
        pattern_text = product.part_ids
        if pattern_text is not None and pattern_text in patterns:
            message = f"is that of {patterns[pattern_text]} too; no id would say which one is meant"
            yield (*place, "part_ids"), message
        if pattern_text is not None:
            patterns[pattern_text] = name
    if settings.products and settings.product not in (None, *settings.products):
        guess = did_you_mean(settings.product or "", list(settings.products))
        message = f"{settings.product!r} is no product{guess}; name one of `products`"
        yield ("product",), message


def _with_files(settings: Settings, path: Path) -> Settings:
    """The settings with absolute paths of effects' files, which are relative to the settings.

    The record of a cycle names the file, and holds its content.
    """
    effects = []
    for entry in settings.model.effects:
        if entry.effect.endswith(".py"):
            file = (path.resolve().parent / entry.effect).resolve()
            sha256 = entry.sha256
            if sha256 is None and file.is_file():
                sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
            entry = entry.model_copy(update={"effect": str(file), "sha256": sha256})
        effects.append(entry)
    model = settings.model.model_copy(update={"effects": effects})
    return settings.model_copy(update={"model": model})
