"""Options for a cell that is really there."""

from __future__ import annotations

from pathlib import Path

import pytest

HARDWARE = "hardware"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("devices that are really there")
    group.addoption(
        "--hardware",
        action="store_true",
        help="run the conformance suite on the devices of --config, and nothing else: they move",
    )
    group.addoption("--config", type=Path, help="settings of the cell for --hardware")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--hardware") != (config.getoption("--config") is not None):
        raise pytest.UsageError("--hardware and --config FILE go together")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--hardware"):
        return
    on_hardware = [
        item
        for item in items
        if isinstance(item, pytest.Function)
        and hasattr(item, "callspec")
        and HARDWARE in item.callspec.params.values()
    ]
    others = [item for item in items if item not in set(on_hardware)]
    config.hook.pytest_deselected(items=others)
    items[:] = on_hardware
