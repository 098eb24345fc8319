"""Data as JSON knows it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Mappings, sequences, arrays and named values as data for `json.dumps`.

    Numbers that are not finite become None: JSON has no infinity.  All others stay the same to the
    last bit.
    """
    match value:
        case Mapping():
            return {key: plain(item) for key, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case np.ndarray() if value.dtype.kind in "fiub" and np.all(np.isfinite(value)):
            return value.tolist()
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case Enum():
            return value.value
        case float() if not math.isfinite(value):
            return None
    return value
