"""Calls from compiled code to compiled code by address: an effect never recompiles the engine.

The engine is compiled once and receives its effects' loops as numbers.  Unlike a `cfunc`, numba's
own calling convention is kept, so that an exception in an effect reaches the caller.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_FLOATS = types.Array(types.float64, 1, "C")

#: (state, lanes, segments, time, params, first row)
FORCE_TYPES = (_FLOATS, types.int64, types.int64, types.float64, _FLOATS, types.int64)
#: (state, lanes, segments, mode, duration, dq, dv, params, first row, memory, first row)
MOMENT_TYPES = (
    _FLOATS,
    types.int64,
    types.int64,
    types.int64,
    types.float64,
    types.float64,
    types.float64,
    _FLOATS,
    types.int64,
    _FLOATS,
    types.int64,
)

#: Modes of a moment loop.
EVALUATE, ADVANCE, REST = 0, 1, 2


def _caller(kinds: tuple[Any, ...]) -> Any:
    @intrinsic
    def call(typingctx: Any, address: Any, arguments: Any) -> Any:
        """Call the function of the given types at `address`."""

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            values = [
                context.cast(builder, builder.extract_value(args[1], i), value_type, kind)
                for i, (value_type, kind) in enumerate(zip(signature.args[1], kinds, strict=True))
            ]
            convention = context.call_conv
            function = convention.get_function_type(types.none, kinds).as_pointer()
            pointer = builder.inttoptr(args[0], function)
            status, _ = convention.call_function(builder, pointer, types.none, kinds, values)
            with cgutils.if_unlikely(builder, status.is_error):  # type: ignore[no-untyped-call]
                convention.return_status_propagate(builder, status)
            return context.get_dummy_value()

        return types.none(types.int64, arguments), codegen

    return call


call_force = _caller(FORCE_TYPES)
call_moment = _caller(MOMENT_TYPES)


def address_of(function: Any) -> int:
    """Address of the only compiled version of a numba function."""
    (compiled,) = function.overloads.values()
    return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))
