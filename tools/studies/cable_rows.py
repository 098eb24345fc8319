"""Studies that try one cable after another: their options, and a CSV file with a row a cable."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"


def options(doc: str, cables: int) -> argparse.ArgumentParser:
    """Those that all have: file, cables, seed, settings.

    doc     of the module; its first line is the description
    cables  tried if no number is given
    """
    parser = argparse.ArgumentParser(description=doc.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="CSV file to write")
    parser.add_argument("--cables", type=int, default=cables)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--config", type=Path, default=CONFIG)
    return parser


@contextmanager
def written(
    path: Path, row: type[DataclassInstance]
) -> Iterator[Callable[[Iterable[DataclassInstance]], Any]]:
    """Writes rows of this type as they come, each as soon as it is known."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(row)])
        writer.writeheader()

        def write(rows: Iterable[DataclassInstance]) -> None:
            writer.writerows(asdict(r) for r in rows)
            file.flush()

        yield write
