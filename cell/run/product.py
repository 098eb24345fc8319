"""What a cell makes: a task, and what the evidence of its cycles says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cell.run.station import Task


@dataclass(frozen=True, eq=False)
class ProductTask:
    """What is done with every cable of a product.

    name         None = the settings have no products
    settings     as resolved, for the records
    files        texts that the settings refer to, by path
    calibration  hash of the calibration's files; None = as typed
    """

    name: str | None
    task: Task
    settings: Mapping[str, Any]
    files: Mapping[str, str] = field(default_factory=dict)
    calibration: str | None = None
