"""A YAML file is read within bounds, and whatever is wrong with it is named at its place."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field

from cell.files.input_error import InputError
from cell.files.yaml_document import (
    MAX_BYTES,
    MAX_PROBLEMS,
    document_of,
    read_yaml,
    validate,
    yaml_text,
)


class Inside(BaseModel):
    name: str = ""


class Maybe(Inside):
    model_config = ConfigDict(extra="forbid")


class Bare(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Small(BaseModel):
    model_config = ConfigDict(extra="forbid")

    maybe: Maybe | None = None
    empty: Bare = Bare()
    some: Annotated[list[int], Field(min_length=1, max_length=2)] = [1]
    inside: Inside = Inside()
    size_m: Annotated[float, Field(gt=0.0, le=10.0)] = 1.0
    count: int = 1
    pair: tuple[float, float] = (0.0, 1.0)


def complaint(folder: Path, text: str | bytes) -> str:
    path = folder / "given.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(InputError) as caught:
        validate(read_yaml(path), Small)
    assert all(str(p).startswith(f"{path}:{p.line}:{p.column}: ") for p in caught.value.problems)
    return str(caught.value)


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 20_000, "nested deeper than 20 levels"),
        ("a: " + "{a: " * 3_000, "nested deeper than 20 levels"),
        ("a: " + "[" * 30 + "]" * 30, "nested deeper than 20 levels"),
        ("a: &a [*a]", "or within itself by an anchor"),
        (BOMB, "makes more than 100000 entries, aliases counted"),
        ("x" * (MAX_BYTES + 1), "limit 0.2 MB"),
        ("size_m: true", "size_m: input should be a valid number (got True)"),
        ("size_m: '0.100'", "a valid number (got '0.100'); write it without quotes"),
        ("count: '2'", "a valid integer (got '2'); write it without quotes"),
        ("size_m:", "size_m: is empty; give a value"),
        ("some: []", "some: has 0 items, needs at least 1"),
        ("some: [1, 2, 3]", "some: has 3 items, needs at most 2"),
        ("maybe: {brim: 1}", "maybe.brim: unknown key; use one of those known here: name"),
        ("empty: {nix: 1}", "empty.nix: unknown key; remove it"),
        ("pair: 1", "pair: must be a list, [a, b, …] (got 1)"),
        ("pair: {a: 1}", "pair: must be a list, [a, b, …]"),
        ("inside: [1]", "inside: must hold entries, `key: value`"),
        ("count: 1.5", "count: input should be a valid integer"),
        ("size_m: " + "9" * 5000, "size_m: cannot be read as a value"),
        ("size_m: " + "9" * 4000, "size_m: input should be"),
        ("size_m: " + "x" * 9000, "input should be a valid number (got 'xxx"),
        ("size_m: 2020-13-45", "size_m: cannot be read as a value"),
        ("size_m: 2020-01-01", "size_m: input should be a valid number"),
        ("size_m: !!python/object/apply:os.getcwd []", "input should be a valid number"),
        ("size_m: !mine 1", "is not YAML: could not determine a constructor"),
        ("size_m: \x00", "is not YAML"),
        (b"size_m: \xff", "is not UTF-8 text; save it as UTF-8"),
        ("a: 1\n---\nb: 2\n", "is not YAML: but found another document"),
        ("size_m: [1", "check indentation, quotes, brackets"),
        ("? [a, b]\n: 1\n", "a list or a mapping is no name of an entry; write a word before"),
        ('"size_m\\e[2J": 1', r"'size_m\x1b[2J': unknown key; did you mean 'size_m'?"),
        ("size_m: 1\nsize_m: 2", "size_m: given twice, first in line 1; remove one"),
    ],
)
def test_what_cannot_be_meant_is_named(tmp_path: Path, text: str | bytes, says: str) -> None:
    told = complaint(tmp_path, text)
    assert says in told
    assert len(told) < 1000


def test_a_thousand_brackets_are_refused_at_once(tmp_path: Path) -> None:
    """All that were open were looked at for every character: 1.2 s of CPU time."""
    begun_s = time.process_time()
    complaint(tmp_path, "[" * 20_000)
    assert time.process_time() - begun_s < 0.3


def test_of_very_many_mistakes_the_first_are_told(tmp_path: Path) -> None:
    told = complaint(tmp_path, "".join(f"k{i}: 1\n" for i in range(10_000))).splitlines()
    assert len(told) == MAX_PROBLEMS + 1
    assert "given.yaml:1:1: k0: unknown key" in told[0]
    assert "and 9980 more; mend these first" in told[-1]


def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, kind in (
        (tmp_path / "pipe", "a pipe or a device"),
        (Path("/dev/zero"), "a pipe or a device"),
        (tmp_path, "a folder"),
    ):
        with pytest.raises(InputError, match=f"{path}:1:1: is {kind}; give the name of a text"):
            read_yaml(path)
    with pytest.raises(InputError, match="cannot be read: File name too long"):
        read_yaml(tmp_path / ("x" * 5000))


def test_an_alias_may_save_writing(tmp_path: Path) -> None:
    path = tmp_path / "alias.yaml"
    path.write_text("a: &a {x: 1e-5, y: no}\nb: *a\n")
    assert read_yaml(path).data == {"a": {"x": 1e-5, "y": "no"}, "b": {"x": 1e-5, "y": "no"}}


def test_what_is_written_is_read_back_in_its_order(tmp_path: Path) -> None:
    data = {"z": 1e-5, "a": [0.1, {"é": "\x1b:"}], "n": None, "t": True, "s": "1e-5", "o": "no"}
    path = tmp_path / "written.yaml"
    path.write_text(yaml_text(data), encoding="utf-8")
    read = read_yaml(path).data
    assert read == data
    assert list(read) == list(data)


@given(st.floats(allow_nan=False), st.booleans())
def test_a_number_is_one_to_every_reader(value: float, inline: bool) -> None:
    """1e-05 is a text by YAML 1.1."""
    text = yaml_text({"a": value, "b": [value, "1e-05"]}, inline=inline)
    wanted = {"a": value, "b": [value, "1e-05"]}
    assert yaml.safe_load(text) == document_of(text, Path("a.yaml")).data == wanted


class Titled(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: Literal["titled/1"]
    name: str


@pytest.mark.parametrize(
    ("text", "model", "says"),
    [
        ("cable: 1\ncamera: 2\n", Titled, ":1:1: is no file of `format: titled/1`, and has cable,"),
        ("name: a\nformat: small/1\n", Titled, ":2:1: format: is 'small/1'; give a file of `form"),
        ("format: titled/1\nname: a\n", Small, ":1:1: format: is 'titled/1'; give settings of a"),
        ("name: a\n", Titled, ":1:1: format: is missing; add it"),
    ],
)
def test_a_file_of_another_kind_is_one_mistake(
    tmp_path: Path, text: str, model: type[BaseModel], says: str
) -> None:
    """Settings given as a motion were told key by key, twelve lines of them."""
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        validate(read_yaml(file), model)
    (problem,) = caught.value.problems
    assert says in str(problem)
