"""Studies of this room are small."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def small_studies(small: None) -> None:
    """In all modules, before their own fixtures."""
