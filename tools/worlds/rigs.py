"""Studies that imitate real rigs: their cables, and the errors of their measurements.

The mesh is finer than the model's and the law of bending of another family (`made_studies.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.cable.dynamics import simulate, simulate_each
from cell.cable.effects import ActiveEffect, library
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.swing import mode_curvature
from cell.cable.wrench import Gauge, Tool
from cell.identify.noise import Noise
from cell.study.data import Markers, Study, Trial, Wrench, WrenchSensor
from tools.worlds.made_studies import (
    STROKES,
    WORLD,
    coloured,
    hidden,
    like,
    logged,
    random_model,
    stroke,
)
from tools.worlds.sensed_grippers import arc, by_accelerometer, by_encoder, drift_of, turning

#: Share of rigs with a feature.
SHARES = {"slow": 0.4, "shapes": 0.4, "connector": 0.3, "curved": 0.3, "glitches": 0.4,
          "one coordinate": 0.2}  # fmt: skip
STARTS = ("at rest", "at rest", "held", "moving")
#: Features that are effects: sizes over the typical one.
AS_EFFECTS = {"connector": ("tip_mass", 1.0, 3.0), "curved": ("natural_curvature", 0.5, 2.0)}
SLOW_FRAME_S = 1.0 / 30.0
#: Shapes of the errors along the cable of a fitted shape.
ERRING_SHAPES = 3


@dataclass(frozen=True)
class ForceSensor:
    """A sensor under the jaws: its rate, noise and colour, true gain, and the tool that it carries.

    Every trial has a tare of its own, of up to some newtons.
    """

    rate_hz: float
    force_n: float
    moment_nm: float
    colour: float
    gain: float
    tool: Tool

    def shown(
        self, rng: np.random.Generator, model: CableModel, hand: Motion, quiet: bool
    ) -> Wrench:
        """Readings for a cable from rest; `quiet`: without errors."""
        t_s = np.arange(rng.uniform(0.0, 1.0 / self.rate_hz), hand.t_s[-1], 1.0 / self.rate_hz)
        tip_m = np.array([model.cable.length_m])
        (gauged,) = simulate_each(model, hand, [t_s], tip_m, gauge=Gauge(self.tool), solver=WORLD)
        values = gauged[:, 1:].reshape(len(t_s), -1)[:, :3]
        if quiet:
            return Wrench(t_s, values)
        sizes = np.array([self.force_n, self.force_n, self.moment_nm])
        noise = sizes * coloured(rng, values.shape, self.colour)
        return Wrench(t_s, self.gain * values + noise + rng.normal(size=3) * [2.0, 2.0, 0.1])

    def stated(self, quiet: bool) -> WrenchSensor:
        """Sensor as stated in a study: with its noise only where the data show none."""
        noise = (self.force_n, self.moment_nm) if quiet else (None, None)
        return WrenchSensor(Gauge(self.tool), *noise)


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig, its cable and its errors of measurement.

    features  except those that are effects
    updates   number of frames with the same error of a fitted shape
    axis      of the only observed coordinate; None = both
    known     effects in the lab's model; unsaid: further present effects
    reach     of the strokes, over those of `STROKES` for a similar cable
    stiffer   rigidity, over that of a similar cable
    clocks    per trial the frames' and the log's steps, s; empty = `frame_s`, and the log's own
    arc_std_m  standard deviation of the markers' arc lengths, which the study states
    parted    a second camera with its own rate and clock observes the outer half of the markers
    counts    per turn, of an encoder of the gripper, which is on an arm of `arm_m`; 0 = no encoder
    turns_rad  turn of a clamp with an accelerometer; None = no accelerometer
    sensor    under the jaws, if there is one
    """

    seed: int
    features: tuple[str, ...]
    cable: Cable
    arc_length_m: np.ndarray
    frame_s: float
    tilt_rad: float
    noise_m: float
    colour: float
    updates: int
    axis: int | None
    start: str
    known: tuple[ActiveEffect, ...]
    unsaid: tuple[ActiveEffect, ...]
    reach: float = 1.0
    stiffer: float = 1.0
    clocks: tuple[tuple[float, float], ...] = ()
    parted: float = 0.0
    arc_std_m: float = 0.0
    counts: int = 0
    arm_m: float = 0.15
    turns_rad: float | None = None
    sensor: ForceSensor | None = None

    @staticmethod
    def drawn(seed: int, effect: str) -> Rig:
        """A rig in which `effect` can be hidden."""
        rng = np.random.default_rng([seed, 1])
        has = [f for f, share in SHARES.items() if rng.uniform() < share]
        if "one coordinate" in has and "shapes" in has:
            has.remove("shapes")
        has = has or ["slow"]
        length, across = rng.uniform(0.5, 1.0), rng.uniform(0.005, 0.009)
        cable = Cable(length, 1200.0 * np.pi / 4.0 * across**2, across, across)
        if "shapes" not in has and rng.uniform() < 0.5:
            cable = Cable(rng.uniform(0.08, 0.15), 0.0074, 0.016, 0.0001)
        length, arcs = cable.free_length_m, node_arc_lengths(cable.free_length_m, 11)
        noise_m, updates = length * float(np.exp(rng.uniform(np.log(5e-4), np.log(3e-3)))), 1
        if "shapes" in has:
            noise_m, updates = rng.uniform(2e-3, 7e-3), int(rng.integers(2, 5))
            arcs = node_arc_lengths(length, int(rng.integers(3, 7)))[:-1]
        tilt_rad = float(rng.choice([0.0, 0.6, 1.2]))
        axis = None
        if "one coordinate" in has:
            arcs, axis = np.array([0.85 * length]), 0 if tilt_rad > 0.6 else 1
        known, unsaid = [], []
        for feature, (name, low, high) in AS_EFFECTS.items():
            if feature in has and name != effect:
                size = rng.uniform(low, high)
                there = hidden(library()[name], size, cable)
                (known if rng.uniform() < 0.5 else unsaid).append(there)
        frame_s = SLOW_FRAME_S if "slow" in has else 0.005 * like(cable, "s")
        features = tuple(f for f in has if f not in AS_EFFECTS)
        return Rig(seed, features, cable, arcs, frame_s, tilt_rad, noise_m, rng.uniform(0.0, 0.6),
                   updates, axis, str(rng.choice(STARTS)), tuple(known), tuple(unsaid))  # fmt: skip

    @property
    def sensed(self) -> bool:
        """Whether the gripper's motion is from a sensor, without a log of its place."""
        return self.counts > 0 or self.turns_rad is not None

    @property
    def noise(self) -> Noise:
        """Noise of its markers, as if all values were independent."""
        colour = max(self.colour, self.sensor.colour if self.sensor else 0.0)
        return Noise(self.noise_m, colour)

    @property
    def independent(self) -> float:
        """Share of independent values, except for AR(1): fitted shapes repeat, with few shapes."""
        if self.updates == 1:
            return 1.0
        return min(1.0, ERRING_SHAPES / len(self.arc_length_m)) / self.updates


def rig_study(rig: Rig, effect: ActiveEffect | None, *, quiet: bool = False) -> Study:
    """The study of a rig with a hidden effect; `quiet`: without errors of measurement."""
    rng, errors = (np.random.default_rng([rig.seed, i]) for i in (2, 4))
    there = (*rig.known, *rig.unsaid, *([effect] if effect else []))
    model = random_model(rng, rig.cable, there)
    model = replace(model, rigidity_n_m2=rig.stiffer * model.rigidity_n_m2)
    arcs_m, trials = rig.arc_length_m, []
    rig = rig if quiet else _with_true_places(rig)
    for number, (name, role, angle, way, seconds) in enumerate(STROKES[:5]):
        slower, longer = like(rig.cable, "s"), rig.reach * like(rig.cable, "m")
        frame_s, log_s = rig.clocks[number] if rig.clocks else (rig.frame_s, 0.0)
        still_s = max(0.2 * slower, 10.0 * frame_s)
        hand = stroke(angle + rig.tilt_rad, (longer * way[0], longer * way[1]), seconds * slower,
                      still_s, 0.9 * slower)  # fmt: skip
        if rig.counts:
            hand = arc(hand, rig.arm_m, way)
        if rig.turns_rad is not None:
            hand = turning(hand, rig.turns_rad)
        drift = None if rig.turns_rad is None else drift_of(hand)
        bent = number % 2 == 0 and rig.start != "at rest"
        start = rig.start if bent else "equilibrium"
        if start == "held":
            hand = replace(hand, x_m=0.0 * hand.x_m, y_m=0.0 * hand.y_m)
        begin_s = rng.uniform(0.0, frame_s)
        if start == "moving":
            begin_s += still_s + rng.uniform(0.7, 1.2) * seconds * slower
        t_s = np.arange(begin_s, hand.t_s[-1], frame_s)
        of_second = np.arange(begin_s, hand.t_s[-1], rig.parted) if rig.parted else t_s
        t_s = np.union1d(t_s, of_second)
        markers_m, moved = _simulate(rng, model, hand, t_s, rig, start, still_s), hand
        hand = _at_steps(hand, log_s) if log_s else hand
        sensor = rig.sensor
        wrench = None if sensor is None else sensor.shown(errors, model, moved, quiet)
        second, outer = np.isin(t_s, of_second), len(rig.arc_length_m) // 2
        views = [(second, slice(None, outer)), (~second, slice(outer, None))] if rig.parted else []
        for (_, markers), (rows, _) in zip(views, reversed(views), strict=True):
            markers_m[rows, markers] = np.nan
        if not quiet:
            for rows, markers in views or [(slice(None), slice(None))]:
                clean = markers_m[rows, markers]
                markers_m[rows, markers] += rig.noise_m * _erring(errors, rig, clean.shape)
            hand = hand if rig.sensed else _noisy_log(errors, rig, hand)
        if rig.axis is not None:
            markers_m[..., 1 - rig.axis] = np.nan
        trials.append(Trial(name, role, start, hand,
                            Markers(t_s, markers_m), still_s if start == "held" else None,
                             drift, wrench))  # fmt: skip
    stated = quiet or {"shapes", "one coordinate"} & set(rig.features)
    std_m = np.full(len(arcs_m), rig.arc_std_m) if rig.arc_std_m else None
    study = Study(f"rig_{rig.seed}", rig.cable, arcs_m, tuple(trials), arc_length_std_m=std_m,
                  noise_std_m=rig.noise_m if stated else None,
                  sensor=rig.sensor.stated(quiet) if rig.sensor else WrenchSensor())  # fmt: skip
    if quiet or not rig.sensed:
        return study
    if rig.counts:
        return by_encoder(study, rig.arm_m, rig.counts)
    return by_accelerometer(study, errors)


def _simulate(
    rng: np.random.Generator,
    model: CableModel,
    hand: Motion,
    t_s: np.ndarray,
    rig: Rig,
    start: str,
    release_s: float,
) -> np.ndarray:
    """(times, markers, 2) of the world; a held cable is bent by fingers at its tip and middle.

    Their curvature has a kink, and they release some milliseconds off the stated time.
    """
    if start != "held":
        return simulate(model, hand, t_s, rig.arc_length_m, solver=WORLD)[0]
    x = np.linspace(0.0, 1.0, 2001)[:-1]
    at_tip, inside = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.7), rng.uniform(-0.3, 0.3)
    added = at_tip * (1.0 - x) + inside * np.clip(0.6 - x, 0.0, None)
    places = np.linalg.lstsq(mode_curvature(x, 6), added, rcond=None)[0]
    late_s = 0.004 * rng.normal()
    bent = [np.stack([places, 0.0 * places])]
    return simulate(model, hand, t_s, rig.arc_length_m, solver=WORLD, start="held",
                    release_s=release_s + late_s, bent=bent)[0]  # fmt: skip


def _erring(rng: np.random.Generator, rig: Rig, shape: tuple[int, ...]) -> np.ndarray:
    """(times, markers, 2) errors of the camera, of rms 1."""
    if rig.updates == 1:
        return coloured(rng, shape, rig.colour)
    times = shape[0]
    updates = -(-times // rig.updates)
    sizes = coloured(rng, (updates, ERRING_SHAPES, 2), rig.colour)
    along = (rig.arc_length_m / rig.cable.free_length_m)[:, None] ** np.arange(1, ERRING_SHAPES + 1)
    along /= np.sqrt(np.mean(np.sum(along**2, axis=1)))
    smooth = np.einsum("tkc,mk->tmc", sizes, along)
    return np.repeat(smooth, rig.updates, axis=0)[:times] + 0.02 * rng.normal(size=shape)


def _with_true_places(rig: Rig) -> Rig:
    """The rig with the true places of its markers."""
    errors = np.random.default_rng([rig.seed, 5]).normal(size=len(rig.arc_length_m))
    places_m = np.clip(rig.arc_length_m + rig.arc_std_m * errors, 0.0, rig.cable.length_m)
    return replace(rig, arc_length_m=np.sort(places_m)[::-1])


def _at_steps(hand: Motion, step_s: float) -> Motion:
    """The motion at the times of a different log."""
    t_s = np.arange(hand.t_s[0], hand.t_s[-1], step_s)
    return Motion(t_s, *(np.interp(t_s, hand.t_s, v) for v in (hand.x_m, hand.y_m, hand.angle_rad)))


def _noisy_log(rng: np.random.Generator, rig: Rig, hand: Motion) -> Motion:
    if "glitches" not in rig.features:
        return logged(rng, hand, 1e-5)
    noisy = logged(rng, hand, 3e-5)
    wrong = [0, *rng.integers(1, len(hand.t_s), 4)]
    noisy.x_m[wrong] += rng.choice([-1.0, 1.0], 5) * rng.uniform(6e-5, 2e-4, 5)
    noisy.y_m[wrong] += rng.choice([-1.0, 1.0], 5) * rng.uniform(6e-5, 2e-4, 5)
    return noisy
