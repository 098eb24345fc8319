"""A machine without ur-rtde: connecting says what is missing, and everything else runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.interfaces import ConnectError
from drivers.plane_mount import PlaneMount
from drivers.ur import UrArm, UrOptions


@pytest.fixture
def arm() -> UrArm:
    return UrArm(UrOptions("127.0.0.1", PlaneMount((0, 0, 0), (1, 0, 0), (0, 0, 1))))


@pytest.mark.parametrize(
    "missing", ["No module named 'rtde_control'", "libboost_thread.so: cannot open shared object"]
)
def test_a_missing_library_is_named_with_its_remedy(
    arm: UrArm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    for name in ("dashboard_client", "rtde_control", "rtde_receive"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError({missing!r})\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(ConnectError) as error:
        arm.connect()
    assert missing in error.value.cause and "ur-rtde cannot be loaded" in error.value.cause
    assert "pip install" in error.value.remedy and "Python 3.11 and 3.12" in error.value.remedy
