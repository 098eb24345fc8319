"""Digital inputs and outputs of a UR controller over RTDE, next to the program that moves the arm.

ur-rtde claims none of these outputs to move an arm, and this needs none of its registers.

source  Universal Robots, "Real-Time Data Exchange (RTDE) Guide": the bits of
        `actual_digital_input_bits` are numbered as here
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator

from drivers.rtde_client import RtdeClient, RtdeError
from drivers.rtde_wire import Recipe
from drivers.threads import GuardedThread, error_text

#: Group of digital inputs or outputs → number of its first, number of its last.
GROUPS = {"standard": (0, 7), "configurable": (8, 15), "tool": (16, 17)}

_INPUTS, _OUTPUTS = "actual_digital_input_bits", "actual_digital_output_bits"
#: Rate of reports; the handshake polls every 50 ms, an arm's connection every 2 ms.
_RATE_HZ = 50.0
#: Longest time to connect or to answer, and pause before a new attempt, s.
_ANSWER_S, _AGAIN_S = 2.0, 0.5
#: Longest time until a written output follows, s: 25 reports.
_FOLLOWS_S = 0.5


class UrIo:
    """Reads a controller's inputs and sets some of its outputs, in a thread, within a `with`.

    A lost connection is made again, without limit.  Inputs are valid only while the outputs are as
    set.  The outputs stay as set last after the end of the `with`.

    host     address of the controller
    outputs    numbers of the outputs that are set; the others stay unchanged
    on_inputs  called with the numbers of the inputs that are on, 50 times a second
    on_loss    called with the reason of a loss, at every attempt
    silence_s  time without a report after which the connection is lost
    """

    def __init__(
        self,
        host: str,
        outputs: Collection[int],
        on_inputs: Callable[[frozenset[int]], None],
        on_loss: Callable[[str], None],
        silence_s: float,
    ) -> None:
        self._host = host
        self._ours = frozenset(outputs)
        self._on_inputs, self._on_loss = on_inputs, on_loss
        self._silence_s = silence_s
        self._wanted: frozenset[int] = frozenset()
        self._over = threading.Event()
        self._thread = GuardedThread("ur-io", self._run, self._died)

    def __enter__(self) -> UrIo:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(2.0 * _ANSWER_S)

    def set(self, on: Collection[int]) -> None:
        """Switch on these of the outputs, and off the others; within 20 ms, or after a loss."""
        self._wanted = self._ours & frozenset(on)

    # --- the thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                with RtdeClient(self._host, _ANSWER_S) as client:
                    self._serve(client)
            except OSError as error:
                self._on_loss(f"{self._host}: {error}")
                self._over.wait(_AGAIN_S)

    def _died(self, error: BaseException) -> None:
        self._on_loss(f"{self._host}: {error_text(error)}; the handshake must be started again")

    def _serve(self, client: RtdeClient) -> None:
        """Read inputs and set outputs until the end, with the last ones set.  Raises OSError."""
        client.report([_INPUTS, _OUTPUTS], _RATE_HZ)
        recipe = client.claim(list(_variables(self._ours))) if self._ours else None
        client.start()
        written: frozenset[int] | None = None
        written_s = 0.0
        while True:
            over, wanted = self._over.is_set(), self._wanted
            if wanted != written:
                written, written_s = wanted, time.monotonic()
                if recipe is not None:
                    client.write(recipe, _values(recipe, self._ours, wanted))
            inputs, outputs = self._reported(client)
            wrong = (outputs & self._ours) ^ written
            if not wrong:
                if over:
                    return
                self._on_inputs(inputs)
            elif time.monotonic() - written_s > _FOLLOWS_S:
                raise RtdeError(
                    f"digital output {min(wrong)} does not follow; has the controller's "
                    "installation given it to something else, or does a program set it?"
                )

    def _reported(self, client: RtdeClient) -> tuple[frozenset[int], frozenset[int]]:
        """Numbers of the inputs and of the outputs that are on.  Raises OSError."""
        values = client.newest(self._silence_s)
        inputs, outputs = values.get(_INPUTS), values.get(_OUTPUTS)
        if not isinstance(inputs, int) or not isinstance(outputs, int):
            raise RtdeError("the controller reports no digital inputs and outputs")
        return _numbers(inputs), _numbers(outputs)


def _groups(numbers: Collection[int]) -> Iterator[str]:
    """Groups in which there are such numbers."""
    for group, (first, last) in GROUPS.items():
        if any(first <= number <= last for number in numbers):
            yield group


def _variables(numbers: Collection[int]) -> Iterator[str]:
    """Input variables of RTDE that set these outputs: the mask of a group, then its bits."""
    for group in _groups(numbers):
        yield f"{group}_digital_output_mask"
        yield f"{group}_digital_output"


def _values(recipe: Recipe, ours: Collection[int], on: Collection[int]) -> list[int]:
    """Values of the variables of `_variables`."""
    values = []
    for name in recipe.names:
        first, last = GROUPS[name.partition("_")[0]]
        which = ours if name.endswith("_mask") else on
        values.append(sum(1 << number - first for number in which if first <= number <= last))
    return values


def _numbers(bits: int) -> frozenset[int]:
    return frozenset(number for number in range(bits.bit_length()) if bits >> number & 1)
