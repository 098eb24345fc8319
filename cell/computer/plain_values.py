"""Numbers, texts and arrays as bytes, and back: whatever the bytes are, nothing of them is run."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

#: Longest message, bytes.
MOST_BYTES = 1 << 28
_HEAD = 8
_DTYPES = ("float64", "int64", "bool")


def encode(value: object) -> bytes:
    """Bytes of None, bool, int, float, str, list, tuple, dict with str keys, and arrays of these.

    raises  TypeError: it holds anything else
    """
    arrays: list[bytes] = []

    def plain(v: Any) -> Any:
        if isinstance(v, np.ndarray) and v.dtype.name in _DTYPES:
            arrays.append(np.ascontiguousarray(v).tobytes())
            return {"array": [v.dtype.name, list(v.shape)]}
        if isinstance(v, np.bool_ | np.integer | np.floating):
            return v.item()
        if isinstance(v, tuple):
            return {"tuple": [plain(x) for x in v]}
        if isinstance(v, list):
            return [plain(x) for x in v]
        if isinstance(v, dict):
            return {"dict": {k: plain(x) for k, x in v.items()}}
        if v is None or isinstance(v, bool | int | float | str):
            return v
        raise TypeError(f"{type(v).__name__} is no plain value")

    head = json.dumps(plain(value)).encode()
    return b"".join([len(head).to_bytes(_HEAD, "little"), head, *arrays])


def decode(content: bytes) -> Any:
    """The value.  Raises ValueError: the bytes are of no value."""
    begin = _HEAD + int.from_bytes(content[:_HEAD], "little")
    if begin > len(content):
        raise ValueError("is cut")
    position = begin

    def value(v: Any) -> Any:
        nonlocal position
        if isinstance(v, list):
            return [value(x) for x in v]
        if not isinstance(v, dict):
            return v
        ((kind, inner),) = v.items()
        if kind == "tuple":
            return tuple(value(x) for x in inner)
        if kind == "dict":
            return {str(k): value(x) for k, x in inner.items()}
        name, shape = inner
        if kind != "array" or name not in _DTYPES or any(n < 0 for n in map(int, shape)):
            raise ValueError("is no array")
        dtype = np.dtype(name)
        size = dtype.itemsize * int(np.prod([int(n) for n in shape], dtype=object))
        part = content[position : position + size]
        if len(part) != size:
            raise ValueError("is cut")
        position += size
        if name == "bool":  # any byte but 0 is true
            return (np.frombuffer(part, np.uint8) != 0).reshape(shape)
        return np.frombuffer(part, dtype).reshape(shape).copy()

    try:
        return value(json.loads(content[_HEAD:begin]))
    except (TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"is no value: {error}") from error
