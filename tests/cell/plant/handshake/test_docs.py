"""What `docs/plant.md` says of the handshake: its settings load, its tables have the numbers."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import yaml

from cell.settings.plant import Handshake, Plant
from cell.settings.plant.handshake import signals_of

PAGE = (Path(__file__).parents[4] / "docs" / "plant.md").read_text(encoding="utf-8")


def test_the_settings_that_are_shown_are_accepted() -> None:
    blocks = re.findall(r"(?m)^    plant:\n(?:     .*\n)+", PAGE)
    plain = [yaml.safe_load(textwrap.dedent(b))["plant"] for b in blocks]
    shown = [Plant.model_validate(section) for section in plain if "handshake" in section]
    carriers = [plant.handshake.carrier for plant in shown if plant.handshake is not None]
    assert carriers == ["modbus", "controller"]


def test_the_tables_have_the_numbers_of_the_settings() -> None:
    rows = re.findall(r"(?m)^\| (\d+) \| `(\w+)` \|", PAGE)
    said = Handshake()
    wanted = [(str(at.number), name) for name, at in signals_of(said.inputs)]
    assert rows == wanted + [(str(at.number), name) for name, at in signals_of(said.outputs)]
