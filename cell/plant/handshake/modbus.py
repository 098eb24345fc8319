"""The handshake over Modbus/TCP: coils that the PLC writes, discrete inputs that it reads."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Self

from cell.plant.handshake.carrier import CarrierError, Heard, bits_of, inputs_of
from cell.plant.handshake.signals import UNKNOWN, Inputs, Outputs
from cell.settings.plant.handshake import Handshake, InputSignals, OutputSignals, signals_of
from drivers.threads import GuardedThread, said

if TYPE_CHECKING:
    from pymodbus.constants import ExcCodes
    from pymodbus.server import ModbusTcpServer

#: Functions of the protocol: the PLC writes one coil or several, and reads discrete inputs.
_WRITE, _READ = (5, 15), 2
#: Bits are kept in words of so many.
_WORD = 16
#: The server begins and ends within this, s.
_BEGIN_S, _END_S = 10.0, 5.0


class ModbusCarrier:
    """A Modbus/TCP server, within a `with`, in a thread of its own.

    raises  CarrierError, from `with`: the address cannot be listened at
    """

    def __init__(self, said: Handshake) -> None:
        self._said = said
        self._heard = Heard(said.silence_s, f"the PLC writes nothing for {said.silence_s:g} s")
        self._coils: set[int] = set()
        self._wired = frozenset(at.number for _, at in signals_of(said.inputs))
        self._written: set[int] = set()
        self._written_s = float("-inf")
        self._told = bits_of(UNKNOWN, said.outputs)
        self._loop = asyncio.new_event_loop()
        self._thread = GuardedThread("modbus", self._serve, self._died)
        self._begun = threading.Event()
        self._server: ModbusTcpServer | None = None
        self._error: BaseException | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        self._begun.wait(_BEGIN_S)
        if self._server is None or self._error is not None:
            self._thread.join(_END_S)
            where = f"{self._said.listen}:{self._said.port}"
            raise CarrierError(
                f"Modbus cannot listen at {where} ({self._error}); is the port free, and may "
                "this user listen at it?"
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._server is not None:
            self._loop.call_soon_threadsafe(self._server.serving.set_result, True)
        self._thread.join(_END_S)

    def read(self) -> Inputs:
        """What the PLC says now.  Raises CarrierError: it wrote not all, or too long ago."""
        return inputs_of(self._heard.read(), self._said.inputs)

    def write(self, outputs: Outputs) -> None:
        """Tell the PLC at its next question."""
        self._told = bits_of(outputs, self._said.outputs)

    # --- the server's thread ------------------------------------------------------------------

    def _serve(self) -> None:
        try:
            self._loop.run_until_complete(self._run())
        finally:
            self._loop.close()

    def _died(self, error: BaseException) -> None:
        """Told where the server was begun, or as a PLC that is away."""
        self._error = error
        self._heard.lose(f"Modbus has ended: {said(error)}; start the handshake again")
        self._begun.set()

    async def _run(self) -> None:
        from pymodbus.server import ModbusTcpServer
        from pymodbus.simulator import DataType, SimData, SimDevice

        def words(places: InputSignals | OutputSignals) -> list[SimData]:
            highest = max((at.number for _, at in signals_of(places)), default=0)
            return [SimData(0, count=highest // _WORD + 1, values=0, datatype=DataType.BITS)]

        unused = [SimData(0, values=0, datatype=DataType.REGISTERS)]
        bits = (words(self._said.inputs), words(self._said.outputs), unused, unused)
        device = SimDevice(id=0, simdata=bits, action=self._asked)
        server = ModbusTcpServer(device, address=(self._said.listen, self._said.port))
        await server.serve_forever(background=True)
        self._server = server
        self._begun.set()
        await server.serving
        server.close()
        await asyncio.sleep(0.0)  # connections are closed by the loop

    async def _asked(
        self,
        function: int,
        first_word: int,
        address: int,
        count: int,
        words: list[int],
        written: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """A question of the PLC: take its coils, or put what it is told into the words."""
        if function in _WRITE and written:
            self._take(dict(enumerate(written, address)))
        elif function == _READ:
            words[:] = _words_of(self._told, len(words))
        return None

    def _take(self, coils: Mapping[int, bool | int]) -> None:
        """Coils that are written; after a silence each of them has to be."""
        now_s = time.monotonic()
        if now_s - self._written_s > self._said.silence_s:
            self._written.clear()
        self._written_s = now_s
        self._written |= coils.keys()
        for number, value in coils.items():
            (self._coils.add if value else self._coils.discard)(number)
        if missing := self._wired - self._written:
            self._heard.lose(f"the PLC has not written coil {min(missing)} yet")
        else:
            self._heard.take(self._coils)


def _words_of(bits: Iterable[int], count: int) -> list[int]:
    words = [0] * count
    for number in bits:
        words[number // _WORD] |= 1 << number % _WORD
    return words
