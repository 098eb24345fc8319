"""The executor for jobs that go where they are to be done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cell.workers.executor import Executor
from cell.workers.here import this_computer


@contextmanager
def executor(
    where: str | int | None = None, tell: Callable[[str], None] = lambda note: None
) -> Iterator[Executor]:
    """An executor until it is left.

    where   address of a scheduler, number of cores of this computer; None = all of its cores
    tell    is told what a person should know of the workers
    raises  WorkersError
    """
    if isinstance(where, str):
        from cell.workers.cluster import cluster  # an extra, and a second to import

        with cluster(where, tell) as found:
            yield found
    else:
        yield this_computer(where)
