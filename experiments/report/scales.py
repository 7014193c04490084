"""Scales of a chart's axes, linear or logarithmic, and round numbers to mark on them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MARGIN = 0.05
"""Share of a range that is added at each end."""


@dataclass(frozen=True)
class Scale:
    """From `low` at share 0 to `high` at share 1; both positive if logarithmic."""

    low: float
    high: float
    log: bool = False

    def share(self, values: ArrayLike) -> Array:
        """Shares of the axis, any shape; beyond 0 and 1 outside. Not positive on log: far below."""
        given = np.asarray(values, dtype=float)
        if not self.log:
            return (given - self.low) / (self.high - self.low)
        lowest = math.log10(self.low)
        logs = np.log10(np.maximum(given, 1e-30))
        return np.asarray((logs - lowest) / (math.log10(self.high) - lowest))

    def ticks(self, count: int) -> list[float]:
        """About `count` round numbers within: 1, 2 or 5 times a power of ten apart."""
        if self.log:
            return self._decades(count)
        rough = (self.high - self.low) / count
        power = 10.0 ** math.floor(math.log10(rough))
        step = power * next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]

    def _decades(self, count: int) -> list[float]:
        first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high))
        every = max(1, -(-(last - first + 1) // max(count, 1)))
        decades = [10.0**k for k in range(first, last + 1, every)]
        if len(decades) >= 2:
            return decades
        fine: list[float] = []
        for factors in ((1.0, 2.0, 5.0), (1.0, 2.0, 3.0, 5.0, 7.0)):
            fine = [
                value
                for k in range(first - 1, last + 1)
                for factor in factors
                if self.low <= (value := factor * 10.0**k) <= self.high
            ]
            if len(fine) > 2:
                return fine
        return fine if len(fine) > 1 else Scale(self.low, self.high).ticks(count)

    @staticmethod
    def words(value: float) -> str:
        """A tick's number, large ones as 10k or 1M."""
        for size, unit in ((1e6, "M"), (1e4, "k")):
            if abs(value) >= size:
                return f"{value / (1e3 if unit == 'k' else 1e6):.4g}{unit}"
        text = f"{value:.6g}"
        return "0" if text == "-0" else text.replace("-", "\N{MINUS SIGN}")


def around(values: Iterable[ArrayLike], *, zero: bool = False, least: float = 1e-9) -> Scale:
    """A linear scale over all finite values with a margin; from 0 on if `zero`."""
    low, high = _ends(values)
    if zero:
        low = min(low, 0.0)
    width = max(high - low, least)
    middle = 0.5 * (low + high)
    low, high = min(low, middle - 0.5 * width), max(high, middle + 0.5 * width)
    return Scale(low if zero and low == 0.0 else low - MARGIN * width, high + MARGIN * width)


def exactly(values: Iterable[ArrayLike]) -> Scale:
    """A linear scale from the least to the greatest value, without a margin."""
    low, high = _ends(values)
    return Scale(low, high if high > low else low + 1.0)


def decades(values: Iterable[ArrayLike], floor: float) -> Scale:
    """A logarithmic scale over all positive values, with a margin; none below `floor`."""
    low, high = _ends(np.maximum(np.asarray(one, dtype=float), floor) for one in values)
    room = max((high / low) ** MARGIN, 1.15)
    return Scale(low / room, high * room, log=True)


def _ends(values: Iterable[ArrayLike]) -> tuple[float, float]:
    flat = [np.ravel(np.asarray(one, dtype=float)) for one in values]
    every = np.concatenate(flat) if flat else np.zeros(0)
    every = every[np.isfinite(every)]
    return (float(every.min()), float(every.max())) if every.size else (0.0, 1.0)
