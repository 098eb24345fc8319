"""The handshake over digital inputs and outputs of the arm's controller, wired to the PLC."""

from __future__ import annotations

from typing import Self

from cell.plant.handshake.carrier import UNKNOWN, Inputs, LatestBits, Outputs, bits_of, inputs_of
from cell.settings.plant import Handshake, signals_of
from drivers.ur_io import UrIo


class ControllerCarrier:
    """A UR controller's inputs and outputs, within a `with`, over a connection of their own.

    host  address of the controller
    """

    def __init__(self, said: Handshake, host: str) -> None:
        self._said = said
        self._heard = LatestBits(said.silence_s, f"{host} reports nothing for {said.silence_s:g} s")
        ours = [at.number for _, at in signals_of(said.outputs)]
        self._io = UrIo(host, ours, self._heard.take, self._heard.lose, said.silence_s)
        self.write(UNKNOWN)

    def __enter__(self) -> Self:
        self._io.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._io.__exit__()

    def read(self) -> Inputs:
        """What the PLC says now.  Raises CarrierError: the controller is away."""
        return inputs_of(self._heard.read(), self._said.inputs)

    def write(self, outputs: Outputs) -> None:
        """Set the outputs, which stay as they are when the program ends."""
        self._io.set(bits_of(outputs, self._said.outputs))
