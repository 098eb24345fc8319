"""What the settings say of where independent fits are done."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from cell.settings.section import Section
from cell.workers.place import place


def scheduler(address: str) -> str:
    """The address itself.  Raises ValueError: it is none."""
    if not isinstance(place(address), str):
        raise ValueError(f"{address!r} is no address of a scheduler; give tcp://host:8786")
    return address


class Workers(Section):
    """Where many independent fits are done: on a cluster, or on cores of this computer."""

    cluster: Annotated[str, AfterValidator(scheduler)] | None = None
    """Address of a Dask scheduler, tcp://host:8786; null = this computer."""
    cores: Annotated[int, Field(ge=1, le=1024)] | None = None
    """Of this computer; null = all."""

    @model_validator(mode="after")
    def _one_place(self) -> Workers:
        if self.cluster is not None and self.cores is not None:
            raise ValueError("has both `cluster` and `cores`; leave one out")
        return self

    @property
    def place(self) -> str | int | None:
        """Address or number of cores; None = all cores."""
        return self.cluster if self.cluster is not None else self.cores
