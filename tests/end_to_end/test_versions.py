"""A whole cycle with controllers whose versions are not proved: newest PolyScope 5, PolyScope X."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cell.wiring.arm_version import FILE

from .conftest import run

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")


@pytest.mark.real_time
@pytest.mark.parametrize(("version", "serial"), [("5.26.0.9", "20225500001"), ("10.13.0.9", None)])
def test_a_cable_is_inserted_with_a_version_somebody_allows(
    light_config: Path, tmp_path: Path, version: str, serial: str | None
) -> None:
    text = light_config.read_text(encoding="utf-8")
    name = ".".join(version.split(".")[:2])
    text = text.replace("\narm:", f'\narm:\n  allow_version: "{name}"')
    text = text.replace("\nemulated:", "\nrecording: null\nemulated:")
    text = text.replace("\n  readout_s:", f'\n  polyscope: "{version}"\n  readout_s:')
    config = tmp_path / "newer.yaml"
    config.write_text(text, encoding="utf-8")
    (host,) = [line.split()[1] for line in text.splitlines() if "  host:" in line]
    passed = {"version": version, "host": host, "serial_number": serial, "speed": 0.1}
    told = [{**passed, "time": "2026-11-25T12:00:00+00:00", "folder": "runs/a-1"}]
    (tmp_path / FILE).write_text(json.dumps(told))
    done = run("run", "-c", config, "--json", "--runs", tmp_path)
    result = json.loads(done.stdout) if done.stdout else {}
    assert result.get("outcome") == "inserted", f"{result.get('reason')} {done.stderr}"
    assert done.returncode == 0
