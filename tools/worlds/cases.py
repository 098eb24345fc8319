"""Reproducible studies with a known answer, each defined by a source, a kind and a number."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cell.cable.effects import Effect, library
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.prepared import PreparedStudy, all_fitted
from cell.lab.data.results import write_json
from cell.study.data import Study
from cell.study.folder import write_study
from tools.worlds.bad_priors import BAD_PRIORS, with_bad_prior
from tools.worlds.breadth_world import Conditions, World, hypercube
from tools.worlds.known_truth import (
    class_of,
    evidence,
    power_of,
    that_shows,
    without_noise,
)
from tools.worlds.made_studies import CABLE, Step, hidden, make_study
from tools.worlds.outside_laws import LAWS
from tools.worlds.rig_kinds import KINDS as RIG_KINDS
from tools.worlds.rigs import Rig, rig_study

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
MADE = ("complete", "step", "one", "unknown", "pair", "mixed", "prior")
BREADTH = ("complete", "one", "outside", "pair", "law")
MUJOCO = ("complete", "step", "mass", "one", "law")
#: A mass that is hidden in a chain of MuJoCo's: share of the cable's mass, and of its length.
POINT_MASS = (0.02, 0.6)
RIGS = ("all", "complete", *RIG_KINDS)


@dataclass(frozen=True)
class Case:
    """Definition of a study for `made`: source, kind and number (or name), and random conditions.

    seed     of all breadth studies, from which their conditions follow
    changed  conditions that are set in all breadth studies
    count    number of breadth studies of the kind, over which the conditions are spread
    """

    source: str
    kind: str
    number: str
    seed: int = 0
    count: int = 0
    changed: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class MadeStudy:
    """A study in a folder, its hidden effects, and the effects that the lab may use.

    hidden   effects to be named; `unsaid`: further present effects that may be named
    power    of the ideal test that knows the truth; 1 without a hidden effect
    noise_m  true noise, nan if not known
    """

    folder: Path
    selection: EffectSelection
    hidden: tuple[str, ...] = ()
    unsaid: tuple[str, ...] = ()
    power: float = 1.0
    noise_m: float = float("nan")
    prior: Path | None = None
    conditions: Mapping[str, float] = field(default_factory=dict)


@contextmanager
def made(case: Case) -> Iterator[MadeStudy]:
    """The study of a case, in a folder that is removed afterwards.

    raises  DivergedError, UnsettledError: the simulation fails
    """
    if case.source in ("practice", "real"):
        yield _existing(case)
        return
    makers = {"made": _usual, "breadth": _broad, "rigs": _of_rig, "mujoco": _by_mujoco}
    with TemporaryDirectory() as root:
        folder = Path(root) / "study"
        study, made_study = makers[case.source](case, folder)
        write_study(study, folder)
        yield made_study


def _existing(case: Case) -> MadeStudy:
    folder = SHARED / case.source / case.number
    if case.source == "real":
        return MadeStudy(folder, EffectSelection((), library()))
    truth = json.loads((folder.parent / "truth.json").read_text(encoding="utf-8"))
    effects = tuple(e for e in truth[case.number]["effects"] if e != "none")
    return MadeStudy(folder, EffectSelection((), library()), effects)


def _usual(case: Case, folder: Path) -> tuple[Study, MadeStudy]:
    known, seed = library(), int(case.number)
    if case.kind in ("complete", "step"):
        step = Step.drawn(seed) if case.kind == "step" else None
        conditions = {} if step is None else asdict(step)
        study = make_study(seed, step=step)
        return study, MadeStudy(folder, EffectSelection((), known), conditions=conditions)
    if case.kind == "prior":
        kind = BAD_PRIORS[seed % len(BAD_PRIORS)]
        study, names, model = with_bad_prior(seed, kind)
        prior = folder.with_name("earlier.json")
        write_json(model.to_dict(), prior)
        return study, MadeStudy(folder, EffectSelection((), known), names, prior=prior)
    effects, sizes = drawn(seed, case.kind, known)
    active = [hidden(e, size) for e, size in zip(effects, sizes, strict=True)]
    names = tuple(e.name for e in effects)
    offered = {"unknown": (), "mixed": effects[:1]}.get(case.kind, effects)
    gone = class_of(e.name for e in effects if e not in offered)
    selection = EffectSelection((), {n: e for n, e in known.items() if n not in gone})
    lacking = {"pair": [[e] for e in effects], "mixed": [effects[:1]]}.get(case.kind, [[]])
    study = make_study(seed, active)
    spaces = [ParameterSpace.of(study.cable, effects=rest) for rest in lacking]
    clean = make_study(seed, active, noise_m=1e-9, colour=0.0)
    quiet = without_noise(clean, PreparedStudy.of(study).noise)
    power = min(power_of(evidence(quiet, s), quiet, len(known)) for s in spaces)
    count = 1 if case.kind == "mixed" else len(names)
    return study, MadeStudy(folder, selection, names[:count], names[count:], power)


def _by_mujoco(case: Case, folder: Path) -> tuple[Study, MadeStudy]:
    """A study by MuJoCo: a step of EI, an effect or a magnet, or nothing beyond the model."""
    from tools.worlds import mujoco_studies as mujoco  # needs mujoco

    seed = int(case.number)
    step, (names, hidden) = (1.0, 0.5), ((), mujoco.Hidden())
    if case.kind == "step":
        step = astuple(Step.drawn(seed))
    elif case.kind == "mass":
        share, place = POINT_MASS
        kilograms = share * CABLE.line_density_kg_per_m * CABLE.free_length_m
        hidden, names = mujoco.Hidden(point_mass=(kilograms, place)), ("point_mass",)
    elif case.kind in ("one", "law"):
        names, hidden = mujoco.drawn(case.seed, seed, case.kind == "law")
    cable = mujoco.specimen(1000 * case.seed + seed, hidden, step)
    # twice the tables' step, which moves the markers by less than a thousandth of the noise
    # twice the links with a hidden mass: with fewer, the chain itself shifts the mass's place
    links = mujoco.LINKS * (2 if "point_mass" in names else 1)
    study = mujoco.study_of(
        cable, seed=1000 * case.seed + seed, step_s=2.0 * mujoco.STEP_S, links=links
    )
    conditions = dict(zip(("factor", "place"), step, strict=True))
    return study, MadeStudy(folder, EffectSelection((), library()), names, conditions=conditions)


def drawn(
    seed: int, kind: str, known: Mapping[str, type[Effect]]
) -> tuple[list[type[Effect]], list[float]]:
    """Effects hidden in a usual study, and the size of each relative to its typical strength."""
    names = sorted(known)
    rng = np.random.default_rng(10_000 + seed)
    first = names[seed % len(names)]
    effects, ranges = [known[first]], [(0.5, 2.0)]
    if kind == "pair":
        effects.append(known[rng.choice([n for n in names if n != first])])
        ranges *= 2
    elif kind == "mixed":
        effects.append(known[rng.choice([n for n in names if n not in class_of([first])])])
        ranges = [(2.0, 5.0), (1.0, 3.0)]
    return effects, [float(rng.uniform(low, high)) for low, high in ranges]


def _broad(case: Case, folder: Path) -> tuple[Study, MadeStudy]:
    place, known = BREADTH.index(case.kind), library()
    conditions = hypercube(case.count, 100 * case.seed + place)[int(case.number)]
    conditions = replace(conditions, **case.changed)
    world, noise_m = World.of(conditions, case.seed), true_noise_m(conditions)
    effects, offered = hidden_effects(case.kind, conditions.number, known, case.seed)
    shown = [world.showing(e) for e in effects]
    clean = shown[0][1] if len(shown) == 1 else world.clean([active for active, *_ in shown])
    lacking = [[o for o in effects if o is not e] for e in effects]
    powers = [_breadth_power(world, clean, case.seed, len(known), rest) for rest in lacking]
    stated = {k: v for k, v in asdict(conditions).items() if k != "number"}
    study, names = world.study(clean, case.seed), tuple(e.name for e in effects)
    selection = EffectSelection((), offered)
    power = min(powers, default=1.0)
    return study, MadeStudy(folder, selection, names, (), power, noise_m, None, stated)


def true_noise_m(conditions: Conditions) -> float:
    """Noise of the measurements including that of rounding, m."""
    return conditions.noise_m * float(np.sqrt(1.0 + conditions.pixel**2 / 12.0))


def hidden_effects(
    kind: str, number: int, known: Mapping[str, type[Effect]], seed: int
) -> tuple[list[type[Effect]], dict[str, type[Effect]]]:
    """The effects hidden in a breadth study, and the effects that the lab may use."""
    names, laws = sorted(known), sorted(LAWS)
    if kind == "complete":
        return [], dict(known)
    if kind == "one":
        return [known[names[number % len(names)]]], dict(known)
    if kind == "pair":
        first = names[number % len(names)]
        others = [n for n in names if n not in class_of([first])]
        second = np.random.default_rng([seed, number, 4]).choice(others)
        return [known[first], known[second]], dict(known)
    if kind == "law":
        return [LAWS[laws[number % len(laws)]]], dict(known)
    if number % 2:
        return [LAWS[laws[number // 2 % len(laws)]]], dict(known)
    effect = known[names[number // 2 % len(names)]]
    return [effect], {n: e for n, e in known.items() if n not in class_of([effect.name])}


def _breadth_power(
    world: World,
    clean: Sequence[np.ndarray],
    seed: int,
    tests: int,
    there: Sequence[type[Effect]],
) -> float:
    """Power of an ideal test that knows the truth, with these effects in its model."""
    conditions = world.conditions
    study = all_fitted(world.study(clean, seed, quiet=True))
    rounding = conditions.pixel**2 / 12.0
    noise = Noise(true_noise_m(conditions), conditions.colour, white=rounding / (1.0 + rounding))
    quiet, space = without_noise(study, noise), ParameterSpace.of(study.cable, effects=there)
    return power_of(evidence(quiet, space), quiet, tests)


def _of_rig(case: Case, folder: Path) -> tuple[Study, MadeStudy]:
    known, seed = library(), int(case.number)
    name = sorted(known)[seed % len(known)]
    rig = RIG_KINDS[case.kind](seed) if case.kind in RIG_KINDS else Rig.drawn(seed, name)
    effect, power = None, 1.0
    if case.kind != "complete":
        effect, power = that_shows(rig, known[name], len(known))
    selection = EffectSelection(tuple(a.effect for a in rig.known), known)
    names = () if effect is None else (effect.effect.name,)
    unsaid = tuple(a.effect.name for a in rig.unsaid)
    return rig_study(rig, effect), MadeStudy(folder, selection, names, unsaid, power)
