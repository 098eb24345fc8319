"""Replaces the section `model` of a settings file or one of its products, and keeps a history."""

from __future__ import annotations

import re
import textwrap
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

from calib.store import CalibrationFileError, load
from cell.files.atomic import write_atomic
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Document, document_of, read_yaml, validate, yaml_text
from cell.files.yaml_edit import last_line
from cell.settings.calibrated import calibration_file, devices_of
from cell.settings.loading import for_product, load_product, load_settings, settings_of
from cell.settings.model import ModelSettings, Settings
from cell.settings.translate import model_hash

#: Speed and resolution of a simulated world are not properties of its cables.
PACE = ("real_time_factor", "segments")
#: Calibrations of a line; missing ones are omitted.
CALIBRATIONS = ("camera", "cell", "time", "grip")
#: Largest number of differences that are listed.
LISTED = 3
_MADE = "made"


def line_identity(settings: Settings) -> dict[str, Any]:
    """Identity of a line: data sheet, devices, calibration and simulated world, as plain data.

    A calibration is identified by its dates: it is repeated on the same line.  Typed values are
    identified by their numbers.
    """
    plain = settings.model_dump(mode="json", include={"cable", "camera", "arm", "world"})
    world = {name: value for name, value in plain["world"].items() if name not in PACE}
    return {
        "cable": plain["cable"],
        "devices": dict(devices_of(settings)),
        "calibration": _calibration(settings, plain),
        "world": world,
    }


def _calibration(settings: Settings, plain: Mapping[str, Any]) -> dict[str, Any]:
    if settings.calibration is None:
        camera, arm = plain["camera"], plain["arm"]
        view, latency_s = camera.get("view"), camera.get("latency_s", 0.0)
        return {"typed": {"view": view, "latency_s": latency_s, "lag_s": arm.get("lag_s")}}
    made = {}
    for kind in CALIBRATIONS:
        try:
            made[kind] = load(calibration_file(settings, kind), kind).made.isoformat()
        except CalibrationFileError:  # reported where the calibration is needed
            continue
    return {_MADE: made}


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """Texts of the first differences between two lines; empty if they are the same line."""
    were, are = dict(_leaves(theirs)), dict(_leaves(ours))
    keys = sorted(k for k in {*were, *are} if not k.startswith(f"calibration.{_MADE}"))
    apart = [key for key in keys if were.get(key) != are.get(key)]
    texts = [f"{key} {were.get(key)}, here {are.get(key)}" for key in apart[:LISTED]]
    return texts + ([f"{len(apart) - LISTED} more"] if len(apart) > LISTED else [])


def other_lines(lines: Sequence[Mapping[str, Any]], settings: Settings) -> list[str]:
    """Sentence about each of the lines that differs from that of the settings."""
    ours = line_identity(settings)
    return [
        f"cycles of another line are among these: {'; '.join(apart)}"
        for line in lines
        if (apart := differences(line, ours))
    ]


def distinct(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lines without duplicates."""
    return [line for i, line in enumerate(lines) if line not in lines[:i]]


def _leaves(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All single values by their dotted key."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _leaves(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, data


FORMAT = "cell-candidate/1"
_KEY = "model"
_PRODUCTS = "products"


@dataclass(frozen=True)
class CandidateModel:
    """A model that was learned, before the line uses it.

    model     the section, as it will be written
    baseline  hash of the model that the line had when it was learned
    failed    gates that it did not pass: name → result
    lines     that it was learned from, as `line_identity` has them; none = not known
    product   of the model; None = settings without products
    """

    path: Path
    model: ModelSettings
    baseline: str
    failed: dict[str, str]
    lines: tuple[dict[str, Any], ...] = ()
    product: str | None = None


def read_candidate(path: Path) -> CandidateModel:
    """Read a candidate's file.  Raises InputError: it is not one, or was edited and is invalid."""
    document = read_yaml(path)
    data = document.data
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        message = f"is no candidate: `format: {FORMAT}` is missing; `cell learn -o` writes one"
        raise InputError([document.problem((), message)])
    problems = [
        document.problem((key,), "is missing; learn it again")
        for key in ("model", "beside", "gates")
        if key not in data
    ]
    if problems:
        raise InputError(problems)
    problems = [
        document.problem(("gates", i), "needs gate, passed and found; learn it again")
        for i, gate in enumerate(data["gates"] if isinstance(data["gates"], list) else [None])
        if not isinstance(gate, dict) or not {"gate", "passed", "found"} <= set(gate)
    ]
    if problems:
        raise InputError(problems)
    lines = data.get("lines", [])
    if not isinstance(lines, list) or not all(isinstance(line, dict) for line in lines):
        message = "is no list of lines; learn it again"
        raise InputError([document.problem(("lines",), message)])
    nested = Document(
        path, data["model"], {k[1:]: v for k, v in document.places.items() if k[:1] == ("model",)}
    )
    failed = {str(g["gate"]): str(g["found"]) for g in data["gates"] if g["passed"] is not True}
    model = validate(nested, ModelSettings)
    product = None if data.get("product") is None else str(data["product"])
    return CandidateModel(path, model, str(data["beside"]), failed, tuple(lines), product)


def promote(candidate: CandidateModel, config: Path, *, from_another_line: bool = False) -> Path:
    """Write the candidate's model into the settings, or into the section of its product.

    The former settings are saved in the history first; then the file is replaced atomically, so
    that after a kill it holds the old settings or the new ones.
    from_another_line  the candidate may have been learned on another line
    returns  the file in the history
    raises   InputError: gates not passed, learned with a different model, on another line or for
             no product of these settings; settings that are wrong or are not one key a line
    """
    config, product = config.resolve(), candidate.product
    before = load_settings(config)
    if product is None and before.products:
        message = "is missing, but the settings have products; learn it with --product"
        raise InputError.at(candidate.path, message, key="product")
    settings = before if product is None else load_product(config, product)
    problems = [
        Problem(candidate.path, 1, None, f"gate {name!r}", f"not passed ({value}); learn from more")
        for name, value in candidate.failed.items()
    ]
    now = model_hash(settings.model)
    if candidate.baseline != now:
        message = (
            f"was learned with the model {candidate.baseline}, the settings now have {now}: "
            "learn it again from cycles with this model"
        )
        problems.append(Problem(candidate.path, 1, None, "beside", message))
    if not from_another_line:
        problems += _of_another_line(candidate, settings)
    if problems:
        raise InputError(problems)
    text = read_exactly(config)
    section = yaml_text({_KEY: candidate.model.model_dump(mode="json", exclude_defaults=True)})
    changed = spliced(config, text, section, product)
    _check(config, changed, before, product)
    entry = next_entry(history_of(config), product)
    write_atomic(entry, text.encode())
    write_atomic(config, changed.encode())
    return entry


def _of_another_line(candidate: CandidateModel, settings: Settings) -> Iterator[Problem]:
    """Problems of a candidate that was learned on another line."""
    remedy = "learn from cycles of this line, or promote it with --from-another-line"
    if not candidate.lines:
        message = f"is missing: nothing says on which line it was learned; {remedy}"
        yield Problem(candidate.path, 1, None, "lines", message)
    ours = line_identity(settings)
    for line in candidate.lines:
        if apart := differences(line, ours):
            message = f"was learned on another line: {'; '.join(apart)}; {remedy}"
            yield Problem(candidate.path, 1, None, "lines", message)


def undo(config: Path, product: str | None = None, *, meant: tuple[str, str] | None = None) -> Path:
    """Restore the model that the settings had before the last promotion; the rest stays.

    product  of the model; None = settings without products
    meant    expected hashes of the present and of the restored model; None = any
    returns  the file in the history with the restored model, now marked as undone
    raises   InputError: there is none, the hashes differ, or the settings would be wrong; nothing
             is written
    """
    config = config.resolve()
    text = read_exactly(config)
    present = section_of(config, text, product)
    for entry in reversed(_entries(config, product)):
        former = section_of(entry, read_exactly(entry), product)
        if former != present:
            changed = spliced(config, text, former, product)
            restored = _hash(config, changed, product)
            if meant is not None:
                _check_expected(config, meant, _hash(config, text, product), restored)
            write_atomic(config, changed.encode())
        entry.rename(entry.with_name(entry.name.replace(".yaml", ".undone.yaml")))
        if former != present:
            return entry
    of = "" if product is None else f" of product {product}"
    message = f"nothing to undo: no model{of} was promoted here, or every promotion is undone"
    raise InputError.at(config, f"{message}; {history_of(config)} has no earlier settings")


def _hash(config: Path, text: str, product: str | None) -> str:
    """Hash of the model in a settings text.  Raises InputError: the text is wrong."""
    settings = settings_of(document_of(text.removeprefix("\ufeff"), config))
    return model_hash((settings if product is None else for_product(settings, product)).model)


def _check_expected(config: Path, meant: tuple[str, str], present: str, restored: str) -> None:
    """Raise InputError unless these are the expected present and restored models."""
    mismatch = ""
    if present != meant[0]:
        mismatch = f"has the model {present} by now, not {meant[0]}"
    elif restored != meant[1]:
        mismatch = f"undoing the last promotion would restore the model {restored}, not {meant[1]}"
    if mismatch:
        remedy = f"choose one of those in {history_of(config)}"
        raise InputError.at(config, f"{mismatch}; {remedy}", key=_KEY)


def history_of(config: Path) -> Path:
    """Folder of the settings before each promotion."""
    return config.with_name(f"{config.stem}.models")


def section_of(path: Path, text: str, product: str | None = None) -> str:
    """The lines of the section `model`, of a product if named; empty if there is none."""
    lines = text.splitlines(keepends=True)
    place = _place(path, text, product)
    return "".join(lines[place.first : place.end])


def spliced(path: Path, text: str, section: str, product: str | None = None) -> str:
    """The text with its section `model` replaced; all other lines are unchanged.

    section  as from `section_of`, or indented like a section of the outermost level
    product  of the model; None = that of the file
    """
    ends = "\r\n" if "\r\n" in text else "\n"
    place = _place(path, text, product)
    if section and not section.startswith(" "):
        section = textwrap.indent(section, " " * place.indent)
    section = section.replace("\r\n", "\n").replace("\n", ends)
    lines = text.splitlines(keepends=True)
    before, after = lines[: place.first], lines[place.end :]
    is_new = place.first == place.end
    if product is None and is_new and section:
        complete = text if text.endswith(("\n", "\r")) else text + ends
        return complete + ends + section
    if not section and not is_new and not after and before and not before[-1].strip():
        before.pop()  # the blank line with which a section is added at the end
    if section and before and not before[-1].endswith(("\n", "\r")):
        before[-1] += ends
    return "".join([*before, section, *after])


@dataclass(frozen=True)
class _Place:
    """Lines of a section, or its future place: first line, line after the last, and indent.

    Comments after it do not belong to it.
    """

    first: int
    end: int
    indent: int = 0


def _place(path: Path, text: str, product: str | None) -> _Place:
    root: Any = YAML(typ="safe", pure=True).compose(text.removeprefix("\ufeff"))
    parent, indent = _one_key_a_line(path, root, ""), 0
    after = len(text.splitlines())
    if product is not None:
        above = _entry(parent, _PRODUCTS)
        products = None if above is None else _one_key_a_line(path, above[1], _PRODUCTS)
        of = None if products is None else _entry(products, product)
        if of is None:
            message = f"{product!r} is no product of these settings"
            raise InputError.at(path, message, key=_PRODUCTS)
        key, value = of
        if isinstance(value, ScalarNode):  # empty: all is as in the rest of the file
            line = key.start_mark.line + 1
            return _Place(line, line, key.start_mark.column + 2)
        parent = _one_key_a_line(path, value, f"{_PRODUCTS}.{product}")
        indent, after = parent.value[0][0].start_mark.column, last_line(value) + 1
    entry = _entry(parent, _KEY)
    if entry is None:
        return _Place(after, after, indent)
    return _Place(entry[0].start_mark.line, last_line(entry[1]) + 1, indent)


def _one_key_a_line(path: Path, node: Node, name: str) -> MappingNode:
    """The node as a mapping.  Raises InputError: it is not one key a line."""
    if isinstance(node, MappingNode) and not node.flow_style:
        return node
    where = "at its outermost level" if not name else "in this section"
    message = f"is not one key a line {where}; write it so to have it changed"
    raise InputError.at(path, message, line=node.start_mark.line + 1 if node else 1, key=name)


def _entry(node: MappingNode, name: str) -> tuple[Node, Node] | None:
    return next(((key, value) for key, value in node.value if key.value == name), None)


def _check(config: Path, changed: str, before: Settings, product: str | None) -> None:
    """Raise InputError if the changed text differs from the former settings beyond the model."""
    after = settings_of(document_of(changed.removeprefix("\ufeff"), config))
    if product is None:
        assert after.model_copy(update={_KEY: before.model}) == before
        return
    was = before.products[product]
    same = after.products[product].model_copy(update={_KEY: was.model})
    assert after.model_copy(update={_PRODUCTS: {**after.products, product: same}}) == before


def next_entry(folder: Path, product: str | None = None) -> Path:
    """Path of the next file of a history; its folder is made.  Raises OSError."""
    folder.mkdir(exist_ok=True)
    numbers = [int(p.name[:4]) for p in folder.glob("[0-9][0-9][0-9][0-9]*.yaml")]
    return folder / f"{max(numbers, default=0) + 1:04d}{_of(product)}.yaml"


def _entries(config: Path, product: str | None) -> list[Path]:
    """Files of the settings before promotions that were not undone, oldest first."""
    named = re.compile(rf"\d{{4,}}{re.escape(_of(product))}\.yaml")
    files = history_of(config).glob("*.yaml")
    return sorted(p for p in files if named.fullmatch(p.name))


def _of(product: str | None) -> str:
    return "" if product is None else f".{product}"


def read_exactly(path: Path) -> str:
    """Text of a file, line endings and byte order mark kept.  Raises OSError; ValueError."""
    with path.open(encoding="utf-8", newline="") as file:
        return file.read()


_LOCK = threading.Lock()


class ChangedMeanwhileError(Exception):
    """The file has changed since it was read.  Scenario: an editor has saved it.

    text  its present content
    """

    def __init__(self, text: str) -> None:
        super().__init__("the file was changed meanwhile")
        self.text = text


def versions_folder(config: Path) -> Path:
    """Folder of the settings before each change."""
    return config.with_name(f"{config.stem}.settings")


def versions(config: Path) -> tuple[Path, ...]:
    """Files that were replaced, the newest first."""
    return tuple(sorted(versions_folder(config.resolve()).glob("[0-9]*.yaml"), reverse=True))


def replace_settings(config: Path, before: str, after: str) -> Path:
    """Write settings atomically; the former file is saved first.

    before   expected present text of the file
    returns  path of the saved former file
    raises   ChangedMeanwhileError; OSError: it cannot be written; the file is unchanged
    """
    config = config.resolve()
    with _LOCK:
        present = read_exactly(config)
        if present != before:
            raise ChangedMeanwhileError(present)
        entry = next_entry(versions_folder(config))
        write_atomic(entry, before.encode())
        write_atomic(config, after.encode())
    return entry
