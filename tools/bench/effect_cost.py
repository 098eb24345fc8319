"""CPU time of identification, offsets and choice with an effect promoted, beside the baseline's.

    python -m tools.bench.effect_cost [--effects robot_ringing …] [--cables 6] [--seed 2600]

A world has the effect at its usual size, and the line's model has it too, with a prior as `cell
learn` would write it: where a fit with nothing known of the effect is sure to within C, four cables
leave C/4.  A cable's hold is identified as `cell run` does it: at 0.2 and 0.6 of the hold, with the
frames to come and all offsets simulated, and once more after the last frame.  The same cable
without the effect, with the baseline model, takes turns with it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.identify.hand import HandErrors
from cell.identify.individual import IdentifyOptions, identify, predict_frames
from cell.identify.model_class import ModelClass
from cell.plan.choose import choose
from cell.run.candidates import simulate_offsets
from cell.run.early_estimate import SHARES
from cell.run.findings import FilmedMotion
from cell.run.station import Task, Timing
from cell.settings import Settings, load_settings
from cell.settings.model import BatchPrior, Model, ModelEffect
from cell.study.data import Markers, Trial
from cell.wiring.build import cell_task
from drivers.interfaces import Trajectory
from tools.bench.bench_task import best_of
from tools.studies.line_study import CONFIG
from tools.studies.loop_study import SEEN
from tools.worlds.fast_cell import fast_cycle, typical, with_world
from tools.worlds.fast_truth import RATE_HZ

#: Cables from which the prior is.
LEARNED_FROM = 4


@dataclass(frozen=True, eq=False)
class Hold:
    """A filmed hold and the task, with what early estimates found of it."""

    task: Task
    timing: Timing
    trial: Trial

    def until(self, share: float) -> Trial:
        """What was filmed until a share of the hold."""
        t_s = self.trial.markers.t_s
        rest_s = float(t_s[-1]) - self.task.hold_s
        seen, grip = t_s <= rest_s + share * self.task.hold_s, self.trial.grip
        logged = grip.t_s <= float(t_s[seen][-1]) + 0.02
        fields = (grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)
        return replace(
            self.trial,
            grip=type(grip)(*(np.ascontiguousarray(v[logged]) for v in fields)),
            markers=Markers(t_s[seen], self.trial.markers.xy_m[seen]),
        )

    def early(self) -> tuple[object, ...]:
        """What is computed while the hold goes on, on one core."""
        task, trial = self.task, self.until(SHARES[1])
        options = _on_one_core(task.identification)
        exact = replace(options, fit=replace(options.fit, hand=HandErrors(samples=0)))
        of_cable = (task.arc_length_m, task.cable)
        first = identify(self.until(SHARES[0]), *of_cable, options=exact)
        found = identify(trial, *of_cable, previous=first, options=exact)
        t_s = self.trial.markers.t_s
        predicted = predict_frames(trial, t_s, task.arc_length_m, found, options)
        start_s = float(t_s[-1]) + task.decide_s
        grip = trial.grip
        hand = Trajectory(grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)
        filmed = FilmedMotion(0.0, (), hand, (), 0.0)
        offsets = simulate_offsets(
            task, self.timing, filmed, trial, found, start_s, Solver(threads=1)
        )
        return found, predicted, offsets

    def late(self, early: tuple[object, ...]) -> object:
        """What is computed after the last frame."""
        task, (before, predicted, offsets) = self.task, early
        found = identify(
            self.trial,
            task.arc_length_m,
            task.cable,
            previous=before,
            predicted=predicted,
            options=task.identification,
        )
        return choose(offsets.forecast, found, task.destination, task.choice)


def _on_one_core(options: IdentifyOptions) -> IdentifyOptions:
    solver = replace(options.fit.solver, threads=1)
    return replace(options, fit=replace(options.fit, solver=solver))


def promoted(settings: Settings, name: str, seed: int) -> ModelClass:
    """The model of a line that has learned an effect."""
    effect, task = library()[name], cell_task(settings)
    kind = replace(task.identification.kind, effects=(effect,))
    unsure = replace(task, identification=replace(task.identification, kind=kind))
    cycle = fast_cycle(settings, seed, 999, task=unsure, errors=SEEN)
    assert cycle.identified is not None
    space = cycle.identified.space
    index = [i for i, n in enumerate(space.names) if n.startswith(f"{name}.")]
    names = tuple(space.names[i] for i in index)
    size = typical(effect, 1.0)
    mean = tuple(size[n.partition(".")[2]] for n in names)
    covariance = cycle.identified.covariance[np.ix_(index, index)] / LEARNED_FROM
    rows = tuple(tuple(row) for row in covariance.tolist())
    return replace(kind, names=names, mean=mean, covariance=rows)


def learned(settings: Settings, name: str, seed: int) -> Settings:
    """A cell whose world has an effect at its usual size, and whose model has learned it."""
    effect = library()[name]
    world = with_world(settings, {name: typical(effect, 1.0)})
    kind = promoted(world, name, seed)
    known = {n.partition(".")[2]: "prior" for n in kind.names}
    prior = BatchPrior(
        names=list(kind.names),
        mean=list(kind.mean),
        covariance=[list(row) for row in kind.covariance],
    )
    model = Model(effects=[ModelEffect(effect=name, parameters=known)], prior=prior)
    return world.model_copy(update={"model": model})


def hold_of(settings: Settings, kind: ModelClass | None, seed: int, number: int) -> Hold:
    """A cable's hold in the world of the settings, to be identified with a model of a kind."""
    task = cell_task(settings)
    if kind is not None:
        task = replace(task, identification=replace(task.identification, kind=kind))
    held = fast_cycle(settings, seed, number, task=cell_task(settings), errors=SEEN).held
    timing = Timing(RATE_HZ, settings.arm.lag_s, settings.camera.frame_rate_hz)
    return Hold(task, timing, held)


def costs(settings: Settings, name: str, seed: int, cables: int) -> np.ndarray:
    """(cables, 2) CPU time with the effect over that without: in all, and after the last frame."""
    size = typical(library()[name], 1.0)
    world = with_world(settings, {name: size})
    kind = promoted(world, name, seed)
    found = []
    for number in range(cables):
        holds = hold_of(settings, None, seed, number), hold_of(world, kind, seed, number)
        early = [hold.early() for hold in holds]  # compiles
        late = best_of(
            *(lambda h=h, e=e: h.late(e) for h, e in zip(holds, early, strict=True)),
            rounds=5,
            clock=time.process_time,
        )
        whole = best_of(*(h.early for h in holds), rounds=2, clock=time.process_time)
        found.append([(whole[1] + late[1]) / (whole[0] + late[0]), late[1] / late[0]])
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--effects", nargs="+", default=sorted(library()))
    parser.add_argument("--cables", type=int, default=6)
    parser.add_argument("--seed", type=int, default=2600)
    options = parser.parse_args()
    settings = load_settings(CONFIG)
    print("CPU time over the baseline's        in all: median, worst   after the last frame")
    for name in options.effects:
        try:
            (whole, late), (worst, latest) = (
                f(costs_, axis=0)
                for costs_ in [costs(settings, name, options.seed, options.cables)]
                for f in (np.median, np.max)
            )
        except (AssertionError, ValueError) as error:
            print(f"{name:24s} not measured: {error}", flush=True)
            continue
        print(f"{name:36s} {whole:6.2f} {worst:6.2f}       {late:6.2f} {latest:6.2f}", flush=True)


if __name__ == "__main__":
    main()
