"""A job as a worker does it: bytes in, bytes out."""

from __future__ import annotations

from typing import Any

from cell.workers.executor import JobResult, WorkersError
from cell.workers.shipping import pack, unpack


def done(function: bytes, job: bytes) -> bytes:
    """Value and error of a job, packed; function and job are as they were packed, every time."""
    value, error = None, None
    try:
        value = unpack(function)(unpack(job))
    except Exception as raised:
        error = raised
    try:
        packed = pack((value, error))
        if error is not None:
            unpack(packed)  # classes of errors with arguments of their own cannot be
    except Exception as unsendable:
        told = unsendable if error is None else error
        return pack((None, RuntimeError(f"{type(told).__name__}: {told}")))
    return packed


def result_of(number: int, packed: bytes) -> JobResult[Any]:
    """The result that `done` packed.  Raises WorkersError: the worker cannot do such jobs."""
    value, error = unpack(packed)
    if isinstance(error, WorkersError):
        raise error
    return JobResult(number, value, error)
