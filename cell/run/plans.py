"""The table of steps, and the plans made of them: inserting, measuring, rehearsing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from functools import partial

from cell.plan.measuring import Measuring
from cell.records.result import Outcome
from cell.run import dry_run, measuring_steps, movements, steps
from cell.run.findings import Filming, Findings
from cell.run.movements import Movements, inserting_movements, measuring_movements
from cell.run.pictures import after_insertion, after_measurement, after_release
from cell.run.station import Station, Task

Act = Callable[[Station, Findings], Findings]


def nothing(station: Station, findings: Findings) -> Findings:
    """Review that changes nothing: returns the findings."""
    return findings


def always(station: Station, findings: Findings) -> bool:
    """Condition that always holds."""
    return True


@dataclass(frozen=True)
class Step:
    """One step of a cycle.

    name           in the record, in faults and in tables
    act            the function: returns the findings after it
    reads          names of the findings that are passed to it
    adds           names of those that it changes: they are passed too, and no other change counts
    after          further work on its findings, outside the step's time
    computes       its time is the computer's, not that of the cell's clock
    holding        it begins with a cable between the jaws and ends with it there
    may_pause      the cell can be held or suspended before it
    time_critical  the gripper waits for the next step: the record is written later
    with_rejected  it is done with a rejected cable too
    once           it is done in the first cycle only; those of `REPEATED_AFTER_LOSS` also after
                   devices were lost
    completed      for `once`: whether it has its result; else the next cycle repeats it
    every          it is done in cycles whose number is a multiple of this
    """

    name: str
    act: Act
    reads: str = ""
    adds: str = ""
    after: Act = nothing
    computes: bool = False
    holding: bool = False
    may_pause: bool = False
    time_critical: bool = False
    with_rejected: bool = False
    once: bool = False
    completed: Callable[[Station, Findings], bool] = always
    every: int = 1

    def apply(self, station: Station, findings: Findings) -> Findings:
        """Findings after it: `act` gets what it reads and adds; only what it adds is updated."""
        added = self.adds.split()
        inputs = {name: getattr(findings, name) for name in (*self.reads.split(), *added)}
        after = self.act(station, Findings(**inputs))
        return replace(findings, **{name: getattr(after, name) for name in added})


@dataclass(frozen=True)
class Repeat:
    """Steps that are repeated until their findings meet a condition.

    A pause is possible after them.
    review  updates the findings after them: station, findings, whether there was a pause
    until   condition on the findings that ends the repetition
    before_repeat  steps before each repetition
    """

    steps: tuple[Step | Repeat, ...]
    review: Callable[[Station, Findings, bool], Findings]
    until: Callable[[Findings], bool]
    before_repeat: tuple[Step, ...] = ()

    @property
    def flat(self) -> tuple[Step, ...]:
        """All steps that are done at least once, in their order."""
        return flat(self.steps)


def flat(stages: Iterable[Step | Repeat]) -> tuple[Step, ...]:
    """All steps in order; those of a `Repeat` are listed once."""
    groups = (e.flat if isinstance(e, Repeat) else (e,) for e in stages)
    return tuple(step for group in groups for step in group)


@dataclass(frozen=True)
class Plan:
    """The steps for one cable, by the state of the cell in which they are done.

    aim        outcome of a cycle in which all goes well
    movements  those of the gripper, for a rehearsal: task, the arm's rate in Hz, factor of the
               speed
    speed      share of the task's speed at which the plan is carried out
    initial_findings  findings before the first step
    """

    aim: Outcome
    movements: Movements
    resetting: tuple[Step, ...]
    starting: tuple[Step, ...]
    execute: tuple[Step | Repeat, ...]
    completing: tuple[Step, ...]
    speed: float = 1.0
    initial_findings: Findings = field(default_factory=Findings)

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps in their order."""
        return flat((*self.resetting, *self.starting, *self.execute, *self.completing))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps in their order, each once."""
        return tuple(dict.fromkeys(step.name for step in self.steps))


#: `adds` of a step after which a cable is tried again.
EVERYTHING = " ".join(field.name for field in fields(Findings))

# --- the table ----------------------------------------------------------------------------------

WARM_UP = Step("warm_up", steps.warm_up, computes=True, once=True)
CONNECT = Step("connect", steps.connect, once=True)
CHECK_PATHS = Step("check_paths", partial(steps.check_paths, inserting_movements), once=True)
RESET = Step("reset", steps.reset)
START = Step("start", steps.check_ready)
GRASP = Step("grasp", steps.grasp, may_pause=True)
GO_HOME = Step(movements.HOME, steps.go_home, with_rejected=True)

LOWER = Step("lower", steps.lower, adds="filming", holding=True, may_pause=True)
HOLD = Step(
    "hold_and_capture",
    steps.hold_and_capture,
    reads="filming",
    adds="held trials hold_saved_s lead_s waiting_since_s",
    holding=True,
    time_critical=True,
)
CHECK_CLOCKS = Step(
    "check_clocks",
    steps.check_clocks,
    reads="held",
    adds="checks",
    computes=True,
    holding=True,
    time_critical=True,
    once=True,
    completed=steps.delays_were_determined,
)
IDENTIFY = Step(
    "identify",
    steps.identify,
    reads="held trials",
    adds="identified outcome reason",
    computes=True,
    holding=True,
    time_critical=True,
)
SIMULATE = Step(
    "simulate",
    steps.simulate,
    reads="held trials identified lead_s",
    adds="simulated_s candidates outcome reason",
    computes=True,
    holding=True,
    time_critical=True,
)
CHOOSE = Step(
    "choose",
    steps.choose,
    reads="identified candidates waiting_since_s",
    adds="choice wait_s outcome reason",
    computes=True,
    holding=True,
    time_critical=True,
)
EXECUTE = Step(
    "execute",
    steps.execute,
    reads="held identified candidates choice",
    adds="executed trials tails stopped predicted",
    holding=True,
)
VERIFY = Step(
    "verify",
    steps.verify,
    reads="candidates choice executed predicted stopped",
    adds="passage outcome reason",
    after=after_insertion,
    computes=True,
    holding=True,
)
BRING_BACK = Step("bring_back", steps.bring_back, adds=EVERYTHING, holding=True, may_pause=True)
RELEASE = Step(
    "release",
    steps.release,
    reads="outcome",
    after=after_release,
    may_pause=True,
    with_rejected=True,
)

#: Steps of a film that was made without this cell.
FILM, LOOK = "film", "look_at_film"

#: Steps with `once` that are repeated after a reconnection: the devices' clocks may have changed.
REPEATED_AFTER_LOSS = frozenset({CONNECT.name, CHECK_CLOCKS.name})
#: Steps with `once` that are repeated for every product.
REPEATED_PER_PRODUCT = frozenset({CHECK_PATHS.name})

CHOOSING = Repeat((SIMULATE, CHOOSE), steps.review_choice, until=lambda f: f.decided)

# --- the plans ----------------------------------------------------------------------------------

INSERTING = Plan(
    aim=Outcome.INSERTED,
    movements=inserting_movements,
    resetting=(WARM_UP, CONNECT, CHECK_PATHS, RESET),
    starting=(START,),
    execute=(
        GRASP,
        Repeat(
            (LOWER, HOLD, CHECK_CLOCKS, IDENTIFY, CHOOSING, EXECUTE, VERIFY),
            steps.review_insertion,
            until=lambda f: f.outcome is not None,
            before_repeat=(BRING_BACK,),
        ),
        RELEASE,
    ),
    completing=(GO_HOME,),
)


def changing_over(plan: Plan, former: Task, *, at_start: bool) -> Plan:
    """Plan of the first cycle after a change of product: it begins by emptying the jaws.

    former    task of the product before it, which defines where its cables are let go
    at_start  the cell was reset for the former product already, and waits in Idle
    """
    empty = Step("empty_jaws", partial(steps.empty_jaws, former))
    reset = tuple(step for step in plan.resetting if step.name in (CHECK_PATHS.name, RESET.name))
    if at_start:
        return replace(plan, starting=(empty, *reset, *plan.starting))
    before = tuple(step for step in plan.resetting if step not in reset)
    return replace(plan, resetting=(*before, empty, *reset))


def measuring(motion: Measuring) -> Plan:
    """Film a cable in a motion, for the model lab, and bring it back to where it was grasped."""
    approach, measure = (
        partial(measuring_steps.approach, motion),
        partial(measuring_steps.measure, motion),
    )
    moves = partial(measuring_movements, motion)
    check = replace(CHECK_PATHS, act=partial(steps.check_paths, moves), once=False)
    return replace(
        INSERTING,
        aim=Outcome.MEASURED,
        movements=moves,
        resetting=(WARM_UP, CONNECT, check, RESET),
        execute=(
            GRASP,
            Step("approach", approach, holding=True, may_pause=True),
            Step(
                "measure",
                measure,
                adds="held trials outcome reason",
                after=after_measurement,
                holding=True,
            ),
            Step("go_back", steps.go_home, holding=True, may_pause=True, with_rejected=True),
            replace(RELEASE, act=steps.let_go, after=nothing, may_pause=False),
        ),
    )


def filmed(filming: Filming, *, decides: bool) -> Plan:
    """Identify the cable of a film that was made without this cell, and execute nothing.

    decides  choose an offset too: the gripper came to where insertions begin
    """
    film = Step(FILM, partial(measuring_steps.begin_film, filming), adds="filming", holding=True)
    conclude = Step(
        "conclude", measuring_steps.conclude, adds="outcome", after=after_measurement, holding=True
    )
    look = replace(HOLD, name=LOOK, act=measuring_steps.detect_in_film, adds="held trials")
    looking = HOLD if decides else replace(look, time_critical=False)
    return replace(
        INSERTING,
        aim=Outcome.MEASURED,
        resetting=(WARM_UP, CONNECT, RESET),
        execute=(GRASP, film, looking, IDENTIFY, *((CHOOSING,) if decides else ()), conclude),
        completing=(),
    )


def rehearsing(plan: Plan, task: Task, rate_hz: float, speed: float) -> Plan:
    """Plan of a dry run: all movements with empty jaws, at a share of their speed, and checks.

    rate_hz  of the arm
    raises   ValueError: a speed that is not > 0 and ≤ 1
    """
    moves = plan.movements(task, rate_hz, speed)
    follow = [
        Step(m.name, partial(dry_run.follow, m), adds="followed", may_pause=True) for m in moves
    ]
    follow[-1] = replace(follow[-1], after=dry_run.after_dry_run)
    return replace(
        plan,
        aim=Outcome.REHEARSED,
        resetting=(
            replace(WARM_UP, act=dry_run.warm_up, once=False),
            CONNECT,
            replace(RESET, act=dry_run.reset, adds="checks"),
        ),
        execute=(
            replace(
                CHECK_PATHS, act=partial(dry_run.check_paths, moves), adds="checks", once=False
            ),
            *follow,
        ),
        speed=speed,
        initial_findings=Findings(speed=speed),
    )
