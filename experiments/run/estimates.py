"""Means with their 95 % intervals over evaluation seeds and over trainings."""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from experiments.run.statistics import CONFIDENCE


@dataclass(frozen=True)
class Estimate:
    """Mean over runs, and half widths of its 95 % intervals.

    `half_width` is that over evaluation seeds, `over_trainings` that over the trainings of an
    agent; each is None where there are not several.
    """

    mean: float
    half_width: float | None = None
    over_trainings: float | None = None

    def words(self, decimals: int, separator: str = " ", factor: float = 1.0) -> str:
        """Write `factor` times the mean and half widths, ± each after `separator`.

        The second ± is that over trainings; where there is one evaluation seed the first is "±–".
        """
        widths = [self.half_width, self.over_trainings]
        while widths and widths[-1] is None:
            widths.pop()
        ends = ["–" if width is None else f"{factor * width:.{decimals}f}" for width in widths]
        return separator.join([f"{factor * self.mean:.{decimals}f}", *(f"±{end}" for end in ends)])


def estimate(values: Sequence[float]) -> Estimate:
    """Return the mean of values; for two or more its interval, t_(0.975, n - 1) s / sqrt(n)."""
    mean = float(np.mean(values))
    n = len(values)
    if n < 2:
        return Estimate(mean)
    quantile = float(student.ppf(0.5 + CONFIDENCE / 2.0, n - 1))
    return Estimate(mean, quantile * float(np.std(values, ddof=1)) / n**0.5)


def two_way(values: Iterable[tuple[Hashable, int | None, float]]) -> Estimate:
    """Return the mean of values that belong to a drive and a training, with both intervals.

    Values of one drive, such as an evaluation seed, are averaged, and the mean of these means has
    its interval over drives; values of one training are averaged likewise, if there are several.
    """
    drives: dict[Hashable, list[float]] = {}
    by_training: dict[int | None, list[float]] = {}
    for drive, training, value in values:
        drives.setdefault(drive, []).append(value)
        by_training.setdefault(training, []).append(value)
    # Most drives have one value, and there may be a hundred thousand of them.
    means = [one[0] if len(one) == 1 else float(np.mean(one)) for one in drives.values()]
    found = estimate(means)
    if len(by_training) < 2:
        return found
    spread = estimate([float(np.mean(group)) for group in by_training.values()])
    return replace(found, over_trainings=spread.half_width)


def range_words(rates: Sequence[float] | NDArray[np.float64]) -> str:
    """Write the least and the largest of the trainings' rates, %."""
    return f"{min(rates):.0f}–{max(rates):.0f} % by training"
