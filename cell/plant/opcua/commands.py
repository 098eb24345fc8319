"""Methods of a unit: a client's call becomes a request to the cell, which may refuse it."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

from asyncua import Server, ua
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol

from cell.plant.messages import CommandReply, Request
from cell.plant.opcua import packml
from cell.plant.opcua.access import ANONYMOUS, caller
from cell.plant.opcua.packml import MACHINE_PATHS, MACHINES, Method
from cell.plant.opcua.space import AddressSpace
from cell.plant.opcua.unit import Unit
from cell.plant.opcua.view import PackmlView
from cell.plant.wire import LONGEST_TEXT, LinkError, NoCellError
from cell.run.machine import MachineEvent

#: Lower bound of the arrival time of the current message, monotonic clock, s.
received_s: ContextVar[float] = ContextVar("received_s")

#: Interval between two notes of the time, s.
_EVERY_S = 0.1


class Idle:
    """Lower bound of the arrival time of messages, from the rounds of the event loop."""

    def __init__(self) -> None:
        now_s = time.monotonic()
        self._noted_s: deque[float] = deque((now_s, now_s), maxlen=2)

    @property
    def lower_bound_s(self) -> float:
        """The second-newest note: the newest may be of the same round as the message."""
        return self._noted_s[0]

    async def note(self) -> None:
        """Note the time at intervals, until cancelled."""
        while True:
            self._noted_s.append(time.monotonic())
            await asyncio.sleep(_EVERY_S)


class _Connection(OPCUAProtocol):  # type: ignore[misc]
    """A connection that stores a lower bound of each message's arrival time."""

    def __init__(self, idle: Idle, **options: Any) -> None:
        super().__init__(**options)
        self._idle = idle
        self._received_s: deque[float] = deque()

    def data_received(self, data: bytes) -> None:
        """Take in messages."""
        waiting = self.messages.qsize()
        super().data_received(data)
        self._received_s.extend([self._idle.lower_bound_s] * (self.messages.qsize() - waiting))

    async def _process_one_msg(self, header: Any, buf: Any) -> bool:
        received_s.set(self._received_s.popleft())
        return bool(await super()._process_one_msg(header, buf))


class _Connections(BinaryServer):  # type: ignore[misc]
    """Listens for connections."""

    def __init__(self, idle: Idle, *options: Any) -> None:
        super().__init__(*options)
        self._idle = idle

    def _make_protocol(self) -> OPCUAProtocol:
        return _Connection(
            self._idle,
            iserver=self.iserver,
            policies=self._policies,
            clients=self.clients,
            closing_tasks=self.closing_tasks,
            limits=self.limits,
        )


class TimedServer(Server):  # type: ignore[misc]
    """asyncua's server, extended by the arrival time of each message."""

    async def start(self) -> None:
        """Listen.  Raises OSError."""
        await self._setup_server_nodes()
        await self.iserver.start()
        idle = Idle()
        self._noting = asyncio.create_task(idle.note())
        try:
            address = self._get_bind_socket_info()
            self.bserver = _Connections(idle, self.iserver, *address, self.limits)
            self.bserver.set_policies(self._policies)
            await self.bserver.start()
        except BaseException:
            self._noting.cancel()
            await self.iserver.stop()
            raise

    async def stop(self) -> None:
        """End."""
        self._noting.cancel()
        await super().stop()


_LOG = logging.getLogger(__name__)

Code = ua.StatusCodes
#: Sends a request to the cell.  Raises LinkError.
Ask = Callable[[Request], CommandReply]


@dataclass(frozen=True)
class Command:
    """A method of a unit.

    path       of the object that has it
    arguments  (name, data type), …
    event      command to the cell; None = something else
    type_id    of the method in the object's type of PackML; None = not of PackML
    """

    path: str
    name: str
    meaning: str
    event: MachineEvent | None = None
    arguments: tuple[tuple[str, str], ...] = ()
    type_id: int | None = None


_TEXT = "String"
_MEANINGS = {
    MachineEvent.START: "begins a cycle",
    MachineEvent.RESET: "makes the cell ready",
    MachineEvent.HOLD: "waits after the motion under way",
    MachineEvent.UNHOLD: "goes on",
    MachineEvent.SUSPEND: "waits for other machines",
    MachineEvent.UNSUSPEND: "goes on",
    MachineEvent.STOP: "stops at once",
    MachineEvent.ABORT: "stops at once, as by a fault",
    MachineEvent.CLEAR: "acknowledges; refused while there is a fault",
}


def _standard() -> list[Command]:
    result, events = [], {event.value for event in MachineEvent}
    for path, machine in zip(MACHINE_PATHS, MACHINES, strict=True):
        for method in machine.methods:
            if method.name.lower() in events:
                event = MachineEvent(method.name.lower())
                head = path, method.name, _MEANINGS[event], event
                result.append(Command(*head, method.arguments, method.id))
    return result


def _of_unit(method: Method) -> Command:
    known = method.name == "SetProduct"
    meaning = "what the next cycles make, by number" if known else "not implemented"
    return Command("", method.name, meaning, None, method.arguments, method.id)


#: All methods.
COMMANDS: tuple[Command, ...] = (
    *_standard(),
    *map(_of_unit, packml.UNIT_METHODS),
    Command(
        "Cell",
        "Start",
        "begins a cycle with this part and product",
        MachineEvent.START,
        (("Part", _TEXT), ("Product", _TEXT)),
    ),
    Command(
        "Cell",
        "Reset",
        "a person acknowledges, and makes the cell ready",
        MachineEvent.RESET,
        (("Name", _TEXT), ("Note", _TEXT)),
    ),
    Command(
        "Cell",
        "Clear",
        "a person acknowledges a fault",
        MachineEvent.CLEAR,
        (("Name", _TEXT), ("Note", _TEXT)),
    ),
    Command("Cell", "SelectProduct", "what the next cycles make", None, (("Product", _TEXT),)),
)


class _RefusedError(Exception):
    """A call is refused before it reaches the cell.  Scenario: too few arguments."""

    def __init__(self, code: int, reason: str, wrong: Sequence[int] = ()) -> None:
        super().__init__(reason)
        self.code, self.wrong = code, wrong


class Methods:
    """Adds the methods to a unit, and answers their calls.

    ask      sends a request to the cell; called in a thread
    view     the present view of the cell
    refused  called with the reason of a refusal; with an empty text after an accepted command
    """

    def __init__(
        self,
        space: AddressSpace,
        unit: Unit,
        ask: Ask,
        view: Callable[[], PackmlView],
        refused: Callable[[str], Awaitable[None]],
    ) -> None:
        self._ask, self._view, self._refused = ask, view, refused
        of_types: dict[ua.NodeId, dict[ua.NodeId, Command]] = {}
        for command in COMMANDS:
            parent, path = unit.id_of(command.path), f"{command.path}.{command.name}".lstrip(".")
            space_of = space.own if command.path == "Cell" else space.packml
            name = space.name(command.name, space_of)
            node = space.method(parent, unit.id_of(path), name, command.meaning)
            if command.arguments:
                space.arguments(node, unit.id_of(f"{path}.InputArguments"), command.arguments)
            self._answer(space, node, {parent: command})
            if command.type_id is not None:
                of_types.setdefault(space.node_id(command.type_id), {})[parent] = command
        for node, by_object in of_types.items():
            self._answer(space, node, by_object)

    def _answer(
        self, space: AddressSpace, node: ua.NodeId, by_object: dict[ua.NodeId, Command]
    ) -> None:
        async def called(of: ua.NodeId, *arguments: ua.Variant) -> ua.CallMethodResult:
            command = by_object.get(of)
            if command is None:
                return _result(Code.BadMethodInvalid)
            return await self._call(command, arguments)

        space.server.iserver.isession.add_method_callback(node, called)

    async def _call(self, command: Command, arguments: Sequence[ua.Variant]) -> ua.CallMethodResult:
        title = command.event.value if command.event else command.name
        try:
            _check(command, arguments)
            plain = self._request(command, [a.Value for a in arguments])
            request = replace(plain, asked_s=received_s.get())
            answer = await asyncio.to_thread(self._ask, request)
        except _RefusedError as refused:
            await self._refused(f"{title}: {refused}")
            return _result(refused.code, refused.wrong, len(arguments))
        except NoCellError:
            await self._refused(f"{title}: the cell does not run")
            return _result(Code.BadNoCommunication)
        except LinkError as error:
            await self._refused(f"{title}: what became of it is not known: {error}")
            return _result(Code.BadCommunicationError)
        await self._refused("" if answer.accepted else f"{title}: {answer.reason}")
        _LOG.info("%s: %s", request, answer)
        return _answered(command, answer)

    def _request(self, command: Command, arguments: Sequence[Any]) -> Request:
        by = f"opcua:{caller.get() or ANONYMOUS}"
        match command.path, command.name:
            case "Cell", "Start":
                part, product = arguments
                return Request(MachineEvent.START, by, part=part or None, product=product or None)
            case "Cell", "Reset" | "Clear":
                name, note = arguments
                if not name or not note:
                    wrong = [Code.Good if a else Code.BadInvalidArgument for a in (name, note)]
                    reason = "an acknowledgement needs a name, and a note of what was done"
                    raise _RefusedError(Code.BadInvalidArgument, reason, wrong)
                return Request(command.event, f"{by} ({name})", note=note)
            case "Cell", "SelectProduct":
                return self._product(by, arguments[0] or "")
            case "", "SetProduct":
                return self._product(by, self._numbered(arguments[0]))
            case "", _:
                raise _RefusedError(Code.BadNotImplemented, "the cell does not do this")
        status = self._view().status
        if command.event in (MachineEvent.RESET, MachineEvent.CLEAR) and status and status.fault:
            reason = "a person must acknowledge the fault: call Cell.Clear or Cell.Reset"
            raise _RefusedError(Code.BadInvalidState, reason)
        return Request(command.event, by)

    def _product(self, by: str, product: str) -> Request:
        status = self._view().status
        if status is not None and product not in status.products:
            known = ", ".join(status.products) or "none"
            reason = f"{product!r} is no product of the cell; those are: {known}"
            raise _RefusedError(Code.BadInvalidArgument, reason, [Code.BadOutOfRange])
        return Request(None, by, product=product)

    def _numbered(self, structures: Sequence[Any] | None) -> str:
        """Name of the product in an argument of SetProduct."""
        status = self._view().status
        products: tuple[str, ...] = () if status is None else status.products
        numbers: list[int] = [s.ProductID for s in structures or ()]
        if len(numbers) != 1 or not 0 < numbers[0] <= len(products):
            reason = f"give one product, with a number from 1 to {len(products)}"
            raise _RefusedError(Code.BadInvalidArgument, reason, [Code.BadOutOfRange])
        return products[numbers[0] - 1]


def _answered(command: Command, answer: CommandReply) -> ua.CallMethodResult:
    """Status code of a reply: wrong argument, too late, or not possible in this state."""
    if answer.accepted:
        return _result(Code.Good)
    if answer.wrong == "asked_s":
        return _result(Code.BadTimeout)
    names = [name.lower() for name, _ in command.arguments]
    if answer.wrong in names:
        wrong = [Code.BadOutOfRange if name == answer.wrong else Code.Good for name in names]
        return _result(Code.BadInvalidArgument, wrong, len(names))
    return _result(Code.BadInvalidState)


def _check(command: Command, arguments: Sequence[ua.Variant]) -> None:
    """Raises _RefusedError: not the arguments of this method.  An array may be empty."""
    if len(arguments) < len(command.arguments):
        raise _RefusedError(Code.BadArgumentsMissing, f"needs {len(command.arguments)} arguments")
    if len(arguments) > len(command.arguments):
        raise _RefusedError(Code.BadTooManyArguments, f"takes {len(command.arguments)} arguments")
    wrong = [
        Code.Good if _has_type(type_, argument) else Code.BadTypeMismatch
        for (_, type_), argument in zip(command.arguments, arguments, strict=True)
    ]
    if any(code != Code.Good for code in wrong):
        wanted = ", ".join(f"{name}: {type_}" for name, type_ in command.arguments)
        raise _RefusedError(Code.BadInvalidArgument, f"the arguments are {wanted}", wrong)


def _has_type(type_: str, argument: ua.Variant) -> bool:
    if argument.Value is None:
        return type_ == _TEXT or type_.endswith("[]")
    if type_.endswith("[]"):
        wanted = type_[:-2]
        return argument.is_array is True and all(type(v).__name__ == wanted for v in argument.Value)
    if argument.VariantType.name != type_ or argument.is_array:
        return False
    return type_ != _TEXT or len(argument.Value) <= LONGEST_TEXT


def _result(code: int, wrong: Sequence[int] = (), argument_count: int = 0) -> ua.CallMethodResult:
    codes = wrong if len(wrong) == argument_count else ()
    return ua.CallMethodResult(
        StatusCode=ua.StatusCode(code), InputArgumentResults=[ua.StatusCode(c) for c in codes]
    )
