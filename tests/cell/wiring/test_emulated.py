"""The scene of an emulated cell; its devices are tested with the drivers, its cycles end to end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

CONFIG = Path(__file__).parents[3] / "config" / "emulated.yaml"

A_SWING = """
from pathlib import Path
import numpy as np
from cell.wiring.emulated import HiddenCableFactory, load_code
from cell.settings import load_settings
from drivers.interfaces import Trajectory

cable = HiddenCableFactory(load_settings(Path(sys.argv[1])), 1, 1)
load_code(cable())
early = compiled()
assert early
swinging, rng = cable(), np.random.default_rng(3)
for portion in range(40):
    t_s = 0.02 * portion + 0.002 * np.arange(1 if portion % 5 == 0 else 9)
    y_m = 0.02 * np.cos(8.0 * t_s) + rng.normal(scale=3e-7 * (portion > 10), size=len(t_s))
    swinging.advance(Trajectory(t_s, 0.0 * t_s, y_m, 0.0 * t_s))
print(*sorted(compiled() - early), sep="\\n")
"""


def test_nothing_is_compiled_while_the_emulated_camera_films(
    knowing_what_is_compiled: Callable[..., list[str]],
) -> None:
    """An arm's own vibration is noise to the spline through its poses now and then."""
    assert knowing_what_is_compiled(A_SWING, CONFIG) == [""]
