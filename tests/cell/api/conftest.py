"""The lab's made studies."""

from tests.cell.lab.conftest import few_effects, make_study

__all__ = ["few_effects", "make_study"]
