"""Searches: the highest value of a setting that an agent passes, such as an entry speed.

By bisection on the grid low, low + resolution, ..., high: the same case tries the same values and
finds the same one, bit for bit. Like every bisection it takes it that an agent passes every value
below one that it passes; the values tried stay in the result.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from trajectories.arguments import Number
from trajectories.naming import choose

Result = dict[str, Any]

SETTINGS = ("fixed_speed", "grip")
"""Settings of a case whose highest value is searched for."""
VALUE = Number(0.0, 1e6, above=True)
MOST_VALUES = 100_000
"""Largest number of values of a grid."""


@dataclass(frozen=True)
class Search:
    """A setting, and the values from `low` to `high`, `resolution` apart, that it may have.

    Raises
    ------
    ValueError
        For an unknown setting, or values that make no grid.
    """

    setting: str
    low: float
    high: float
    resolution: float

    def __post_init__(self) -> None:
        choose("setting of a search", self.setting, SETTINGS)
        for name in ("low", "high", "resolution"):
            object.__setattr__(self, name, VALUE.of(f"search: {name}", getattr(self, name)))
        if not self.low < self.high <= self.low + MOST_VALUES * self.resolution:
            raise ValueError(
                f"search: high must be above low, {self.low:g}, by at most {MOST_VALUES} times the "
                f"resolution, {self.resolution:g}, not {self.high:g}"
            )

    @property
    def metric(self) -> str:
        """Name of the metric that holds the highest value passed."""
        return f"highest_{self.setting}"

    @property
    def last(self) -> int:
        """Number of the grid's last value, which does not exceed `high`."""
        return int((self.high - self.low) / self.resolution + 1e-9)

    def value(self, number: int) -> float:
        """Return a value of the grid."""
        return round(self.low + number * self.resolution, 9)

    def run(self, drive: Callable[[float], Result]) -> Result:
        """Return what `drive` returns for the highest value passed, or for the lowest if none is.

        Its metrics get that value, and of closed paths `fastest_lap` (s), the least lap time of all
        drives that passed; `tried` is the list of the values tried and whether they passed.
        """
        tried: dict[int, bool] = {}
        laps: list[float] = []
        kept: Result = {}

        def passed(number: int) -> bool:
            nonlocal kept
            result = drive(self.value(number))
            tried[number] = passes(result)
            if tried[number] or not kept:
                kept = result
            if tried[number] and "lap_time" in result["metrics"]:
                laps.append(result["metrics"]["lap_time"])
            return tried[number]

        low, high = 0, self.last
        if passed(low):
            if high > low and passed(high):
                low = high
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (middle, high) if passed(middle) else (low, middle)
            kept["metrics"][self.metric] = self.value(low)
            if laps:
                kept["metrics"]["fastest_lap"] = min(laps)
        return {**kept, "tried": [[self.value(number), tried[number]] for number in tried]}


def passes(result: Mapping[str, Any]) -> bool:
    """Return whether a drive reached the end of its path and touched no cone."""
    clear = float(result["metrics"].get("cone_clearance", 0.0)) >= 0.0
    return result["end"] == "finished" and clear
