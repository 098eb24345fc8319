"""Events: every transition of the cell's state, for clients that subscribe to the server."""

from __future__ import annotations

from datetime import UTC, datetime

from asyncua import ua
from asyncua.common.event_objects import TransitionEvent
from asyncua.server.event_generator import EventGenerator

from cell.plant.opcua.machines import MACHINE_PATHS, MACHINES, active_states, transition_between
from cell.plant.opcua.space import AddressSpace, Ids
from cell.plant.opcua.unit import Unit
from cell.plant.opcua.view import PackmlView

#: Severity of a transition, and of one that a fault or a stop has brought about.
_USUAL, _GRAVE = 100, 700


class Transitions:
    """Tells clients of transitions."""

    def __init__(self, space: AddressSpace, unit: Unit, generators: list[EventGenerator]) -> None:
        self._space, self._unit, self._generators = space, unit, generators

    @classmethod
    async def at(cls, space: AddressSpace, unit: Unit) -> Transitions:
        """Events of the server, whose sources are the state machines of a unit."""
        generators = []
        for path in MACHINE_PATHS:
            event = TransitionEvent(sourcenode=unit.id_of(path), message="")
            generators.append(
                await space.server.get_event_generator(event, emitting_node=Ids.Server)
            )
        return cls(space, unit, generators)

    async def tell(self, before: PackmlView, after: PackmlView, at_s: float) -> None:
        """Tell of the transition between two views, at a Unix time."""
        if before.status is None or after.status is None:
            return
        was, now = before.status.state, after.status.state
        level, name, known = transition_between(was, now)
        event, machine = self._generators[level].event, MACHINES[level]
        ids = {s.name: self._space.node_id(s.id) for s in machine.states}
        source, target = active_states(was)[level], active_states(now)[level]
        event.Transition, event.FromState, event.ToState = map(
            ua.LocalizedText, (name, source, target)
        )
        for field, value in (
            ("FromState/Id", ids[source]),
            ("ToState/Id", ids[target]),
            ("Transition/Id", None if known is None else self._space.node_id(known.id)),
        ):
            setattr(event, field, ua.Variant(value))  # a field of any type is a variant in one
        event.Severity = _GRAVE if target in ("Aborting", "Stopping") else _USUAL
        message = f"{was.value} to {now.value}"
        await self._generators[level].trigger(datetime.fromtimestamp(at_s, UTC), message)
