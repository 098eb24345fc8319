"""Studies of a world finer than the model: 60 segments, half the step, coloured noise."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.cable.dynamics import simulate_each
from cell.cable.effects import ActiveEffect, Effect, library
from cell.cable.geometry import node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify.parameters import ParameterSpace
from cell.lab.data import named_effects, prepared, work
from cell.lab.data.work import Progress, no_progress
from cell.lab.search.fit_cache import FitCache, SearchSetup
from cell.study.data import Markers, Study, Trial
from tools.worlds.made_studies import CABLE, WORLD, Step, Stroke, coloured, moved

PRACTICE = Path(__file__).parents[4] / "shared" / "data" / "practice"
REAL = Path(__file__).parents[4] / "shared" / "data" / "real"

#: A line's solver, for half of what the lab's own costs: its error is small in these studies.
COARSE = Solver(segments=24, step_s=1.5e-3)
#: After the gripper has stopped, s.
HOLD_S = 0.25

MakeStudy = Callable[..., Study]


@contextmanager
def coarse_mesh() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepared, "SOLVER", COARSE)
        yield


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    """Studies are fitted on a coarse mesh but where a test asks for `own_mesh`."""
    with coarse_mesh():
        yield


STROKES = (
    Stroke("identify", "fit", 0.0, (0.0, -0.05), 0.3),
    Stroke("up", "fit", -0.9, (0.0, -0.05), 0.3),
    Stroke("left", "validate", 0.0, (-0.05, 0.0), 0.25),
    Stroke("deep", "validate", 0.0, (0.0, -0.08), 0.35),
)

#: What nearly every test needs; the others name `LONG`.
FEW_STROKES = (STROKES[0], STROKES[1], STROKES[3])
LONG: dict[str, Any] = {"strokes": STROKES, "hold_s": 0.5}


def rounded(study: Study, step_m: float, origin_m: float = 0.0) -> Study:
    """The study with its markers on a grid."""

    def on_grid(trial: Trial) -> np.ndarray:
        return origin_m + step_m * np.round((trial.markers.xy_m - origin_m) / step_m)

    return study.with_places(on_grid)


@pytest.fixture(scope="session")
def make_study() -> MakeStudy:
    def make(
        effects: Sequence[ActiveEffect] = (),
        *,
        seed: int = 0,
        noise_m: float = 1e-4,
        ar1: float = 0.3,
        strokes: Sequence[Stroke] = FEW_STROKES,
        hold_s: float = HOLD_S,
        step: tuple[float, float] | None = None,
    ) -> Study:
        """step: EI is so many times as large beyond a share of the free length."""
        rng = np.random.default_rng(seed)
        rigidity = 2.5e-5 * np.exp(rng.uniform(-0.2, 0.2, 4))
        model = CableModel(CABLE, rigidity, 1.05, 1e-7, effects=tuple(effects))
        if step is not None:
            model = Step(*step).in_model(model)
        arcs = node_arc_lengths(0.1)
        motions, times_s = [], []
        for stroke in strokes:
            t = np.arange(0.0, 0.2 + stroke.seconds + hold_s, 0.002)
            motions.append(moved(t, stroke.way_m, stroke.seconds, angle_rad=stroke.angle_rad))
            times_s.append(np.arange(0.002, t[-1], 0.005))
        trials = []
        made = simulate_each(model, motions, times_s, arcs, solver=WORLD)  # as fast as a single one
        for stroke, motion, t_s, clean in zip(strokes, motions, times_s, made, strict=True):
            seen = clean + noise_m * coloured(rng, clean.shape, ar1)
            trials.append(
                Trial(stroke.name, stroke.role, "equilibrium", motion, Markers(t_s, seen))
            )
        return Study("made", CABLE, arcs, tuple(trials))

    return make


def fits_of(
    study: Study,
    effects: Iterable[str | type[Effect]] = (),
    known: Iterable[str | type[Effect]] = (),
    progress: Progress = no_progress,
    **options: Any,
) -> FitCache:
    """The baseline of a study, fitted; a search may add these effects, named or given.

    known    effects that are in the baseline
    options  of `PreparedStudy.of`
    """
    present, chosen = (
        [library()[e] if isinstance(e, str) else e for e in some] for some in (known, effects)
    )
    ready = prepared.PreparedStudy.of(study, **options)
    space = ParameterSpace.of(study.cable, effects=present, gravity_m_per_s2=study.gravity_m_per_s2)
    return FitCache.of(SearchSetup(ready, space, {e.name: e for e in chosen}, progress))


#: Alike, unlike and not smooth.
FEW_EFFECTS = ("tip_mass", "air_drag", "natural_curvature", "grip_angle")


@pytest.fixture(scope="module")
def few_effects() -> Iterator[set[str]]:
    """Commands try these alone, so that they are quick: the docs' sessions try the library."""
    few = {name: library()[name] for name in FEW_EFFECTS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(named_effects, "library", lambda: few)
        yield set(few)


@pytest.fixture
def own_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lab's own mesh and step, where what they err by is asked."""
    monkeypatch.setattr(prepared, "SOLVER", work.SOLVER)


@pytest.fixture
def practice(own_mesh: None) -> Path:
    if not PRACTICE.is_dir():
        pytest.skip("the practice studies are not beside this checkout")
    return PRACTICE


@pytest.fixture
def real(own_mesh: None) -> Path:
    if not REAL.is_dir():
        pytest.skip("the measured studies are not beside this checkout")
    return REAL
