"""Compiled code on disk is used again, and only with the sources it came from."""

from __future__ import annotations

from pathlib import Path

import calib.lens
import cell.vision
from cell.computer.compiling import compiler, hash_of
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
