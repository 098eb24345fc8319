"""Compiled code on disk is used again, and only with the sources it came from."""

from __future__ import annotations

import gc
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features
from numba import njit
from numba.core.dispatcher import Dispatcher
from numba.core.registry import CPUDispatcher

import calib.lens
import cell.cable
import cell.vision
from cell.computer.compiling import Part, compiler, hash_of, inline, part, widest_vectors
from cell.vision.compiling import compiled


def test_the_hash_changes_with_any_source(tmp_path: Path) -> None:
    one, two = tmp_path / "one.py", tmp_path / "two.py"
    one.write_text("a = 1\n")
    two.write_text("b = 1\n")
    before = hash_of([one, two])
    assert hash_of([two, one]) == before
    two.write_text("b = 2\n")
    assert hash_of([one, two]) != before


def test_code_is_stamped_with_all_sources_of_its_package() -> None:
    def twice(x: float) -> float:
        return 2.0 * x

    package = [*Path(cell.vision.__file__).parent.glob("*.py"), Path(calib.lens.__file__)]
    stamps = [
        decorate(twice)._cache._cache_file._source_stamp
        for decorate in (compiled, compiler(lambda: "another"))
    ]
    assert stamps == [hash_of(package), "another"]


@pytest.mark.skipif(
    not get_host_cpu_features().get("avx512f"), reason="the processor has no wider vectors"
)
def test_widest_vectors_are_used_where_they_are_asked_for() -> None:
    @njit
    def double(x):
        widest_vectors()
        for i in range(x.size):
            x[i] *= 2.0

    double(np.ones(16))
    (code,) = double.inspect_asm().values()
    assert "zmm" in code


def test_what_only_compiled_code_can_call_says_so() -> None:
    """It has no entry from Python: to call it all the same would end the process."""

    @inline
    def plus_one(x):
        return x + 1.0

    @njit
    def call(x):
        return plus_one(x)

    assert call(1.0) == 2.0
    with pytest.raises(TypeError, match="plus_one: only compiled code can call it"):
        plus_one(1.0)


def test_a_number_written_down_is_a_number_as_any_other() -> None:
    @part
    def scaled(x, by):
        return by * x

    @njit
    def call(x, by):
        return scaled(x, 2) + scaled(x, 3) + scaled(x, by)

    assert call(1.0, 4) == 9.0
    assert len(scaled.signatures) == 1


def test_the_garbage_collector_is_as_it_was() -> None:
    @compiled
    def twice(x):
        return 2.0 * x

    for is_on in (False, True):
        gc.disable()
        if is_on:
            gc.enable()
        twice(1.0 if is_on else 1)
        assert gc.isenabled() is is_on


@pytest.mark.parametrize("package", [cell.cable, cell.vision])
def test_what_is_computed_does_not_depend_on_who_compiled_it(package) -> None:
    """A process that compiles has each function apart, one that loads it has it in its callers.

    The two are optimised differently, and their last digits differ.  So what compiled functions of
    the engine and of vision call becomes part of them.
    """
    modules = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    known = {m.name: vars(importlib.import_module(m.name)) for m in modules}
    functions = [f for names in known.values() for f in names.values() if isinstance(f, Dispatcher)]
    assert len(functions) > 30
    apart = [
        f"{f.py_func.__name__} calls {name}"
        for f in functions
        for name in f.py_func.__code__.co_names
        if isinstance(called := f.py_func.__globals__.get(name), CPUDispatcher)
        and not isinstance(called, Part)
    ]
    assert not apart, "decorate what is called with `inline` or `part`"


def test_code_that_another_process_can_leave_is_looked_for_on_the_disk(tmp_path: Path) -> None:
    program = tmp_path / "shared.py"
    program.write_text(
        "from cell.computer.compiling import compiler, is_to_be_compiled\n"
        "@compiler(lambda: 'stamp')\ndef twice(x):\n    return 2.0 * x\n"
        "print(is_to_be_compiled(twice), twice(1.0))\n"
    )
    command = [
        sys.executable,
        "-c",
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import shared",
    ]
    said = [subprocess.check_output(command, text=True).strip() for _ in range(2)]
    assert said == ["True 2.0", "False 2.0"]


_PROGRAM = """
from typing import NamedTuple
from cell.computer.compiling import compiler

class {kind}(NamedTuple):
    x: float

@compiler(lambda: "{stamp}")
def twice(point):
    return 2.0 * point.x

print(twice({kind}(21.0)))
"""


def test_compiled_code_of_an_older_program_is_no_mistake(tmp_path: Path) -> None:
    """A type that it was compiled for has another name by now."""
    program = tmp_path / "program.py"
    said = []
    for kind, stamp in (("Spot", "old"), ("Place", "new")):
        program.write_text(_PROGRAM.format(kind=kind, stamp=stamp))
        command = [
            sys.executable,
            "-c",
            f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import program",
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said.append(done.stdout.strip() or done.stderr)
    assert said == ["42.0", "42.0"]
    assert list(tmp_path.glob("__pycache__/*.nbi"))
