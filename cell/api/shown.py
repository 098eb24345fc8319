"""A result that a notebook shows as tables, and that becomes a data frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cell.files.table import TableData

if TYPE_CHECKING:
    import pandas as pd

#: A row of a data frame by its columns.
Row = dict[str, Any]


class Shown:
    """A result: sentences and tables for people, plain data and rows for programs."""

    def parts(self) -> Sequence[str | TableData]:
        """What the command prints, in its order."""
        raise NotImplementedError

    def rows(self) -> list[Row]:
        """The main table, one entry per column."""
        raise NotImplementedError

    def to_frame(self) -> pd.DataFrame:
        """The main table as a data frame, numbers in SI units.

        raises  ImportError: pandas is not installed
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError(
                "data frames need pandas; install it with: pip install 'cable-cell[notebook]'"
            ) from error
        return pd.DataFrame.from_records(self.rows())

    def __repr__(self) -> str:
        """The first sentence that the command prints."""
        sentences = [part for part in self.parts() if isinstance(part, str)]
        said = sentences[0] if sentences else self.parts()[0]
        return f"<{type(self).__name__}: {said if isinstance(said, str) else said.title}>"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from cell.files.page import fragment  # templates: not needed without a notebook

        return fragment(self.parts())
