"""Random rigs of one kind each, which users may have in contrast to the cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cell.cable.geometry import Cable, Connector, node_arc_lengths
from cell.cable.wrench import Tool
from tools.worlds.made_studies import CABLE, FRAME_S, STROKES, like
from tools.worlds.rigs import ForceSensor, Rig


def connector(seed: int) -> Rig:
    """Rig whose cable ends in a stated connector, with markers on it, too.

    It has 0.2 to 3 times the mass of its cable, 5 to 30 % of its length, and up to 1.5 times the
    inertia of a rod.
    """
    rng = np.random.default_rng([seed, 41])
    mass_kg = CABLE.line_density_kg_per_m * CABLE.free_length_m * rng.uniform(0.2, 3.0)
    rod = Connector.rod(float(mass_kg), float(CABLE.free_length_m * rng.uniform(0.05, 0.3)))
    body = replace(rod, inertia_kg_m2=rod.inertia_kg_m2 * float(rng.uniform(1.0, 1.5)))
    return _plain(rng, seed, "connector", replace(CABLE, connector=body))


def laser(seed: int) -> Rig:
    """Rig with a laser that measures one coordinate of the tip at 500 Hz."""
    rng = np.random.default_rng([seed, 42])
    rig = _plain(rng, seed, "laser", CABLE)
    tilt_rad = float(rng.choice([0.0, 1.2]))
    return replace(rig, arc_length_m=np.array([CABLE.free_length_m]), frame_s=0.002,
                   noise_m=float(np.exp(rng.uniform(np.log(1e-5), np.log(1e-4)))),
                   colour=float(rng.uniform(0.0, 0.3)), tilt_rad=tilt_rad,
                   axis=0 if tilt_rad > 0.6 else 1)  # fmt: skip


def long(seed: int) -> Rig:
    """A round cord of 0.5 to 3 m, 0.4 to 2.5 times as stiff as a similar one, moved by up to 0.5 m.

    Filmed 60 to 120 times a second with an error of 0.1 to 0.5 ‰ of its length.
    """
    rng = np.random.default_rng([seed, 43])
    length_m, across_m = rng.uniform(0.5, 3.0), rng.uniform(0.004, 0.012)
    cable = Cable(length_m, 1200.0 * np.pi / 4.0 * across_m**2, across_m, np.pi / 4.0 * across_m)
    rig = _plain(rng, seed, "long", cable)
    farthest_m = like(cable, "m") * max(np.hypot(*way) for *_, way, _ in STROKES)
    return replace(rig, frame_s=1.0 / rng.uniform(60.0, 120.0), reach=min(1.0, 0.5 / farthest_m),
                   noise_m=length_m * float(np.exp(rng.uniform(np.log(1e-4), np.log(5e-4)))),
                   stiffer=float(np.exp(rng.uniform(np.log(0.4), np.log(2.5)))))  # fmt: skip


def clocks(seed: int) -> Rig:
    """Rig with different rates of camera and log per trial; half have a second camera for the tip.

    Every sample has its true time; only the sampling differs.
    """
    rng = np.random.default_rng([seed, 44])
    rig = _plain(rng, seed, "clocks", CABLE)
    steps = [(1.0 / rng.uniform(60.0, 500.0), 1.0 / rng.uniform(100.0, 1000.0)) for _ in STROKES]
    second_s = 1.0 / rng.uniform(60.0, 500.0) if seed % 2 else 0.0
    return replace(rig, clocks=tuple(steps), parted=second_s)


def arcs(seed: int) -> Rig:
    """Rig with nine markers whose arc lengths have a stated error of 0.2 to 1 % of the length."""
    rng = np.random.default_rng([seed, 45])
    rig = _plain(rng, seed, "arcs", CABLE)
    places_m = np.linspace(0.95, 0.15, 9) * CABLE.free_length_m
    std_m = float(rng.uniform(2e-3, 1e-2)) * CABLE.free_length_m
    return replace(rig, arc_length_m=places_m, arc_std_m=std_m)


def encoder(seed: int) -> Rig:
    """The gripper is on an arm of 0.15 m; an encoder of its axle has 2¹⁴ to 2²⁰ counts a turn."""
    rng = np.random.default_rng([seed, 46])
    rig = _plain(rng, seed, "encoder", CABLE)
    return replace(rig, counts=2 ** int(rng.integers(14, 21)))


def accelerometer(seed: int) -> Rig:
    """A sensor on the clamp with noise of 0.02 m/s² at 1 kHz, 0.1 m/s² off; in half it turns."""
    rng = np.random.default_rng([seed, 47])
    rig = _plain(rng, seed, "accelerometer", CABLE)
    return replace(rig, turns_rad=0.2 * (seed % 2))


def wrench(seed: int) -> Rig:
    """A round cord of 0.3 to 0.8 m with a force/torque sensor under the jaws and one marker.

    The sensor has a noise of 5 mN and 0.2 mN·m, white in every other rig, and a gain error of 1 %;
    in half of the rigs it carries 20 g of jaws, which the study states.
    """
    rng = np.random.default_rng([seed, 46])
    length_m, across_m = rng.uniform(0.3, 0.8), rng.uniform(0.005, 0.009)
    cable = Cable(length_m, 1200.0 * np.pi / 4.0 * across_m**2, across_m, np.pi / 4.0 * across_m)
    rig = _plain(rng, seed, "wrench", cable)
    colour = float(rng.uniform(0.3, 0.8)) if seed % 2 else 0.0
    tool = Tool(0.02, (0.03, 0.0), 1e-5) if rng.uniform() < 0.5 else Tool()
    sensor = ForceSensor(float(rng.uniform(125.0, 1000.0)), 5e-3, 2e-4, colour,
                         1.0 + 0.01 * float(rng.normal()), tool)  # fmt: skip
    return replace(
        rig,
        arc_length_m=np.array([0.9 * length_m]),
        sensor=sensor,
        frame_s=1.0 / rng.uniform(60.0, 200.0),
        noise_m=length_m * float(np.exp(rng.uniform(np.log(2e-4), np.log(1e-3)))),
    )


def _plain(rng: np.random.Generator, seed: int, feature: str, cable: Cable) -> Rig:
    noise_m = float(np.exp(rng.uniform(np.log(5e-5), np.log(3e-4))))
    return Rig(seed, (feature,), cable, node_arc_lengths(cable.length_m), FRAME_S, 0.0, noise_m,
               float(rng.uniform(0.0, 0.6)), 1, None, "at rest", (), ())  # fmt: skip


KINDS: dict[str, Callable[[int], Rig]] = {
    f.__name__: f for f in (connector, laser, long, clocks, arcs, encoder, accelerometer, wrench)
}
