"""What shortens the wait while numba compiles: two listeners that are active only then."""

import gc
from typing import Any

from numba.core import event, types
from numba.core.types.functions import BaseFunction


class Collector(event.Listener):
    """Keeps the garbage collector off while compiling, of which it would take a tenth.

    What numba builds survives, so the collector would walk an ever larger heap and free little.
    """

    def __init__(self) -> None:
        self.depth, self.was_on = 0, False

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        """Begin, at the outermost function."""
        if self.depth == 0:
            self.was_on = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        """Undo it, after the outermost function."""
        self.depth -= 1
        if self.depth == 0 and self.was_on:
            gc.enable()


class Arithmetic(event.Listener):
    """Remembers what numba finds for the types of operations on plain numbers, while compiling.

    For every product of two floats numba asks all that could be meant by a product (of strings,
    lists, arrays, ...) anew, which is an eighth of the time that it takes to compile.
    """

    def __init__(self) -> None:
        self.depth = 0
        self.plain = BaseFunction.get_call_type
        self.known: dict[tuple[int, tuple[Any, ...]], Any] = {}
        self.functions: dict[int, Any] = {}
        """Those of `known` by id, which keeps their ids theirs."""

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        """Begin, at the outermost function."""
        self.depth += 1
        if self.depth == 1:
            known, functions, plain = self.known, self.functions, self.plain

            def get_call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
                if kws or not all(type(kind) in NUMBERS for kind in args):
                    return plain(function, context, args, kws)
                key = id(function), tuple(args)
                if key not in known:
                    known[key] = plain(function, context, args, kws)
                    functions[id(function)] = function
                return known[key]

            setattr(BaseFunction, "get_call_type", get_call_type)  # noqa: B010

    def on_end(self, event: event.Event) -> None:  # noqa: ARG002  part of the protocol
        """Undo it, after the outermost function."""
        self.depth -= 1
        if self.depth == 0:
            setattr(BaseFunction, "get_call_type", self.plain)  # noqa: B010
            self.known.clear()
            self.functions.clear()


NUMBERS = (types.Float, types.Integer, types.Boolean)
"""Types of numbers without a literal value."""
