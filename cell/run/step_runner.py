"""Runs the steps of a cycle in order, with pauses, measured times and records."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

from cell.run.commands import RESUMING, Commands
from cell.run.machine import Machine, MachineEvent
from cell.run.plans import REPEATED_PER_PRODUCT, Repeat, Step
from cell.run.progress import CycleProgress
from drivers.interfaces import DeviceError

_LOG = logging.getLogger(__name__)


class StepRunner:
    """Runs the steps of each state, and obeys commands before, within and after each step.

    on_step  called with cycle number and step name as each step begins
    """

    def __init__(
        self, machine: Machine, commands: Commands, on_step: Callable[[int, str], None]
    ) -> None:
        self._machine = machine
        self._commands = commands
        self._on_step = on_step
        self._done_once: set[tuple[str, str | None]] = set()

    def repeat(self, names: Iterable[str]) -> None:
        """Let steps of these names with `once` be done once more."""
        again = set(names)
        self._done_once = {done for done in self._done_once if done[0] not in again}

    def forget(self) -> None:
        """Let every step with `once` be done once more."""
        self._done_once.clear()

    def carry_out(self, progress: CycleProgress, sequence: Iterable[Step | Repeat]) -> None:
        """Do the steps that are due, in order."""
        for element in sequence:
            match element:
                case Step():
                    if self._is_due(progress, element):
                        if element.may_pause:
                            self._pause(progress)
                        self._do(progress, element)
                case Repeat():
                    again = False
                    while not element.until(progress.findings):
                        if again:
                            self.carry_out(progress, element.before_repeat)
                        self.carry_out(progress, element.steps)
                        again = True
                        paused = self._pause(progress)
                        progress.findings = element.review(
                            progress.station, progress.findings, paused
                        )

    def send(self, progress: CycleProgress, event: MachineEvent) -> None:
        """Let the machine take a transition, and record it."""
        state = self._machine.send(event).value
        progress.record.state(state=state)
        progress.recording.state(state, None)

    def _is_due(self, progress: CycleProgress, step: Step) -> bool:
        return (
            _once(progress, step) not in self._done_once
            and progress.number % step.every == 0
            and (step.with_rejected or not progress.findings.rejected)
        )

    def _do(self, progress: CycleProgress, step: Step) -> None:
        """Do a step, its further work, and its record."""
        progress.step = step.name
        state = self._machine.state.value
        progress.record.state_soon(step=step.name, state=state, seconds=progress.seconds)
        progress.recording.state(state, step.name)
        if not step.time_critical:
            progress.recording.record_findings(progress.findings, progress.station)
        self._on_step(progress.number, step.name)
        now_s = time.perf_counter if step.computes else progress.station.devices.clock.now_s
        begun_s = now_s()
        progress.watch.holding = step.holding
        try:
            self._commands.check()
            findings = step.apply(progress.station, progress.findings)
            self._commands.check()
        except DeviceError:
            self._commands.check()  # a device that refuses because of a stop is not the cause
            raise
        finally:
            passed_s = now_s() - begun_s
            progress.seconds[step.name] = progress.seconds.get(step.name, 0.0) + passed_s
            _LOG.info("cycle %d: step %s took %.3f s", progress.number, step.name, passed_s)
        progress.findings = findings
        if step.once and step.completed(progress.station, findings):
            self._done_once.add(_once(progress, step))
        if findings.rejected or not step.time_critical:
            progress.record.state_soon()
            progress.write()
        progress.findings = step.after(progress.station, findings)
        if progress.findings is not findings:
            progress.write()

    def _pause(self, progress: CycleProgress) -> bool:
        """Hold or suspend if requested, until resumed; whether there was a pause."""
        paused = False
        while (pause := self._commands.pause) is not None:  # a second one may follow
            self.send(progress, pause)
            self.send(progress, MachineEvent.DONE)
            self._on_step(progress.number, self._machine.state.value)
            self._commands.wait_until_resumed(pause)
            self.send(progress, RESUMING[pause])
            self.send(progress, MachineEvent.DONE)
            paused = True
        return paused


def _once(progress: CycleProgress, step: Step) -> tuple[str, str | None]:
    """Key of a step that is done once."""
    return step.name, progress.product if step.name in REPEATED_PER_PRODUCT else None
