"""Checks of arguments: a value in the form that its users work with, or a ValueError of one line.

A rule says which numbers an argument may be, and holds its unit; `Number.of` and `Whole.of` apply
it. Whatever is given, be it text, a nested list, or an object whose own methods raise, is either a
number within the rule or refused by a message that shows it, shortened.
"""

import functools
import inspect
import math
import operator
import reprlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from types import UnionType
from typing import Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

LARGEST = sys.float_info.max

P = ParamSpec("P")


class _Short(reprlib.Repr):
    """Reprs that fit on a line; Python refuses to write integers of 4300 digits."""

    def repr_int(self, x: int, level: int) -> str:
        if x.bit_length() > 512:
            return f"an integer of {x.bit_length()} bits"
        return super().repr_int(x, level)


SHORT = _Short()
SHORT.maxstring = SHORT.maxother = 80


def shown(value: object) -> str:
    """Return the repr of a value that anybody may have given, shortened to one line."""
    try:
        return shortened(SHORT.repr(value), 120)
    except RecursionError:  # lists inside a list thousands deep
        return f"a nested {type(value).__name__}"


def shortened(text: object, most: int = 200) -> str:
    """Return a text as one printable line; the middle of a text longer than `most` is left out."""
    line = " ".join(str(text).split())
    if len(line) > most:
        line = f"{line[: most // 2]} ... {line[-most // 3 :]}"
    return line if line.isprintable() else ascii(line)[1:-1]


def _plain(value: Any) -> Any:
    """Return the number in an array or tensor of no dimensions, and any other value as it is.

    A bool is no number: None stands for it.
    """
    if not isinstance(value, Real) and getattr(value, "ndim", None) == 0:
        value = value.item()
    return None if isinstance(value, bool) else value


@dataclass(frozen=True)
class Number:
    """Rule of an argument that is a real number.

    Parameters
    ----------
    low, high
        Bounds, which are among the numbers; an infinite one allows infinity.
    unit
        Unit, for messages.
    above
        True leaves `low` itself out.
    """

    low: float = -LARGEST
    high: float = LARGEST
    unit: str = ""
    above: bool = False

    def holds(self, number: float) -> bool:
        """Return whether a number is within the bounds; NaN never is."""
        return (self.low < number if self.above else self.low <= number) and number <= self.high

    def of(self, name: str, value: Any) -> float:
        """Return an argument's value as a float.

        Raises
        ------
        ValueError
            Naming the argument, if the value is not a number within the bounds.
        """
        if type(value) is float and self.holds(value):
            return value
        try:
            given = _plain(value)
            number = math.nan
            if isinstance(given, Real):
                number = float(given)
        except Exception:  # noqa: BLE001  methods of a user's object may raise anything
            number = math.nan
        if not self.holds(number):
            raise ValueError(f"{name} must be {self}, not {shown(value)}")
        return number

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.low > -LARGEST and self.low != 0.0:
            return f"in {'(' if self.above else '['}{self.low:g}, {self.high:g}]{unit}"
        if self.low < 0.0:
            size = "a finite number" if self.high >= LARGEST else f"at most {self.high:g}"
        elif self.high == math.inf:
            size = "positive" if self.above else ">= 0"
        else:
            size = "positive and " if self.above else ">= 0 and "
            size += "finite" if self.high >= LARGEST else f"at most {self.high:g}"
        return size + unit


@dataclass(frozen=True)
class Whole:
    """Rule of an argument that is a whole number from `low` to `high`, both included."""

    low: int
    high: int
    unit: str = ""

    def of(self, name: str, value: Any) -> int:
        """Return an argument's value as an int.

        Raises
        ------
        ValueError
            Naming the argument, if the value is not a whole number within the bounds.
        """
        if type(value) is int and self.low <= value <= self.high:
            return value
        try:
            given = _plain(value)
            number = None
            if isinstance(given, Integral):
                number = operator.index(given)
        except Exception:  # noqa: BLE001  methods of a user's object may raise anything
            number = None
        if number is None or not self.low <= number <= self.high:
            raise ValueError(f"{name} must be {self}, not {shown(value)}")
        return number

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"a whole number from {self.low:,} to {self.high:,}{unit}"


def numbers(name: str, value: Any, rule: Number, count: int) -> tuple[float, ...]:
    """Return `count` numbers that keep to a rule, from a list, a tuple, a vector or a tensor.

    Raises
    ------
    ValueError
        Naming the argument, if there are more or fewer, or one is not within the bounds.
    """
    given = value
    if not isinstance(value, list | tuple):
        try:
            given = value.tolist()
        except Exception:  # noqa: BLE001  methods of a user's object may raise anything
            given = None
    if not isinstance(given, list | tuple) or len(given) != count:
        raise ValueError(f"{name} must be {count} numbers, each {rule}, not {shown(value)}")
    return tuple(rule.of(f"{name}[{k}]", one) for k, one in enumerate(given))


def array(name: str, value: Any) -> NDArray[np.float64]:
    """Return numbers as an array of floats, which is a copy only if it must be.

    Raises
    ------
    ValueError
        Naming the argument, for what is no array of numbers.
    """
    try:
        return np.asarray(value, dtype=np.float64)
    except Exception:  # noqa: BLE001  conversions of a user's object may raise anything
        raise ValueError(f"{name} must be numbers, not {shown(value)}") from None


def flag(name: str, value: Any) -> bool:
    """Return True or False, also for 1 and 0.

    Raises
    ------
    ValueError
        Naming the argument, for anything else.
    """
    if isinstance(value, bool | np.bool_) or (type(value) is int and value in {0, 1}):
        return bool(value)
    raise ValueError(f"{name} must be True or False, not {shown(value)}")


def instance_of(name: str, value: Any, wanted: type | UnionType, words: str) -> Any:
    """Return a value of a wanted type.

    Raises
    ------
    ValueError
        Naming the argument and saying in words what it must be, for a value of another type.
    """
    if not isinstance(value, wanted):
        raise ValueError(f"{name} must be {words}, not {shown(value)}")  # noqa: TRY004
    return value


def check_fields(instance: object, rules: Mapping[str, Number | Whole], prefix: str = "") -> None:
    """Replace fields of a frozen dataclass by what their rules make of them.

    `prefix` stands before a field's name in messages.

    Raises
    ------
    ValueError
        Naming the first field that does not keep to its rule.
    """
    for name, rule in rules.items():
        object.__setattr__(instance, name, rule.of(f"{prefix}{name}", getattr(instance, name)))


def checks_arguments(**rules: Number | Whole) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Decorate an `__init__`: the arguments named here become what their rules make of them.

    Raises
    ------
    ValueError
        Naming the first argument that does not keep to its rule.
    """

    def decorate(initialise: Callable[P, None]) -> Callable[P, None]:
        signature = inspect.signature(initialise)

        @functools.wraps(initialise)
        def checked(*arguments: P.args, **named: P.kwargs) -> None:
            given = signature.bind(*arguments, **named)
            for name in rules.keys() & given.arguments.keys():
                given.arguments[name] = rules[name].of(name, given.arguments[name])
            initialise(*given.args, **given.kwargs)

        return checked

    return decorate
