"""The lab's made studies."""

from tests.cell.lab.conftest import make_study

__all__ = ["make_study"]
