"""Bootstrap over drives and trainings: what is drawn as one, and within which stratum.

Drives of one seed share their disturbances whatever the path, so that a seed is drawn for all paths
at once: every path keeps its number of drives in each resample, which is thereby stratified by
path. Paths that were driven once, as under conditions without chance, are drawn as tasks within
their setting.
"""

import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import DegenerateDataWarning, bootstrap, norm
from scipy.stats import t as student

from experiments.run.statistics import CONFIDENCE, RESAMPLES

Array = NDArray[Any]
Statistic = Callable[..., Array]
"""Maps the draws of drives (resamples, drives), and for each competitor those of its trainings
(resamples, trainings), to statistics (statistics, resamples)."""

MOST_DRAWS = 20_000_000
"""Bound on drives times resamples; of many drives fewer resamples are drawn."""
FEWEST = 1000
"""Fewest resamples of many drives."""
AT_ONCE = 2_000_000
"""Draws of drives that are held at once: bounds memory."""


@dataclass(frozen=True)
class Plan:
    """Units that a bootstrap draws.

    Parameters
    ----------
    unit
        Unit of each drive, (drives,).
    strata
        Units of each stratum of two or more; units of no stratum are kept in each resample.
    words
        Says what is drawn within what.
    """

    unit: NDArray[np.intp]
    strata: tuple[NDArray[np.intp], ...]
    words: str


def plan_of(cells: Sequence[tuple[Hashable, Hashable, Hashable]]) -> Plan:
    """Plan the bootstrap of drives, each given by its setting, path and seed."""
    seeds: dict[tuple[Hashable, Hashable], set[Hashable]] = {}
    for setting, path, seed in cells:
        seeds.setdefault((setting, path), set()).add(seed)
    common = {cell: frozenset(found) for cell, found in seeds.items()}
    counts = Counter((setting, path) for setting, path, _ in cells)
    alone = Counter(setting for (setting, _), count in counts.items() if count == 1)
    units: dict[Hashable, int] = {}
    strata: dict[tuple[str, Hashable], set[int]] = {}
    unit = np.empty(len(cells), dtype=np.intp)
    for place, (setting, path, seed) in enumerate(cells):
        cell = setting, path
        name: Hashable = place
        if len(common[cell]) > 1:
            stratum: tuple[str, Hashable] = ("seeds", common[cell])
            name = seed
        elif counts[cell] > 1:
            stratum = ("path", cell)
        else:
            # A setting of one drive is drawn with the others of that kind.
            stratum = ("setting", setting if alone[setting] > 1 else None)
        unit[place] = units.setdefault((stratum, name), len(units))
        strata.setdefault(stratum, set()).add(int(unit[place]))
    drawn = {name: found for name, found in strata.items() if len(found) > 1}
    arrays = (np.array(sorted(found), dtype=np.intp) for found in drawn.values())
    paths = sum(len(found) > 1 for found in common.values())
    return Plan(unit, tuple(arrays), _words(drawn, paths, kept=len(strata) > len(drawn)))


def _words(strata: dict[tuple[str, Hashable], set[int]], paths: int, *, kept: bool) -> str:
    """Say what is drawn; `paths` is the number of paths whose seeds are."""
    sizes: dict[str, list[int]] = {}
    for (kind, _), found in strata.items():
        sizes.setdefault(kind, []).append(len(found))
    parts = []
    if seeds := sizes.get("seeds"):
        least, most = min(seeds), max(seeds)
        number = f"{least}" if least == most else f"{least} to {most}"
        parts.append(
            f"{number} seeds, stratified by path ({paths} path{'s' * (paths != 1)}; a seed is "
            "drawn for all it drives)"
        )
    if drives := sizes.get("path"):
        parts.append(
            f"{sum(drives)} drives, each path's apart "
            f"({len(drives)} path{'s' * (len(drives) != 1)})"
        )
    if alone := sizes.get("setting"):
        parts.append(
            f"{sum(alone)} drives that are alone on their path, each setting's apart "
            f"({len(alone)} setting{'s' * (len(alone) > 1)})"
        )
    if kept and parts:
        parts.append("one drive that is alone in its setting and stays in every resample")
    return "; ".join(parts)


@dataclass(frozen=True)
class Intervals:
    """Statistics of all drives, (statistics,), and the ends of their intervals.

    An end is NaN where there is nothing to draw.
    """

    value: Array
    low: Array
    high: Array
    resamples: int


def bootstrap_intervals(
    statistic: Statistic,
    plan: Plan,
    trainings: Sequence[int] = (),
    *,
    draw_drives: bool = True,
    draw_trainings: bool = True,
    seed: int = 0,
) -> Intervals:
    """Compute statistics and their 95 % expanded percentile intervals by SciPy's bootstrap.

    Strata are resampled independently of one another, and of the trainings of each competitor,
    whose numbers are `trainings`.

    Parameters
    ----------
    statistic
        Statistics of draws.
    plan
        Drives and their strata.
    trainings
        Number of trainings of each competitor; those with one keep it.
    draw_drives, draw_trainings
        False keeps all drives, or all trainings: the interval is over the others alone.
    seed
        Seed of the resampling.
    """
    drives = len(plan.unit)
    ones = np.ones((1, drives)), *(np.ones((1, number)) for number in trainings)
    value = statistic(*ones)[:, 0]
    strata = plan.strata if draw_drives else ()
    sides = [k for k, number in enumerate(trainings) if draw_trainings and number > 1]
    samples = [np.arange(len(found)) for found in strata]
    samples += [np.arange(trainings[k]) for k in sides]
    if not samples:
        none = np.full(value.shape, np.nan)
        return Intervals(value, none, none, 0)
    units = int(plan.unit.max()) + 1

    def of(*indices: Array, axis: int) -> Array:
        assert axis == -1
        many = indices[0].ndim == 2
        batch = len(indices[0]) if many else 1
        counts = np.ones((batch, units))
        for found, drawn in zip(strata, indices, strict=False):
            counts[:, found] = _counts(np.atleast_2d(drawn), len(found))
        draws = [np.ones((batch, number)) for number in trainings]
        for k, drawn in zip(sides, indices[len(strata) :], strict=True):
            draws[k] = _counts(np.atleast_2d(drawn), trainings[k])
        found = statistic(counts[:, plan.unit], *draws)
        return found if many else found[:, 0]

    width = drives * max((1, *trainings))
    resamples = int(min(RESAMPLES, max(FEWEST, MOST_DRAWS // width)))
    # Statistics that a resample does not have are NaN, of which SciPy warns.
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateDataWarning)
        result = bootstrap(
            samples, of, n_resamples=resamples, batch=max(1, AT_ONCE // width), vectorized=True,
            axis=-1, method="percentile", confidence_level=CONFIDENCE,
            rng=np.random.default_rng(seed),
        )  # fmt: skip
    freedom = [sum(len(found) for found in strata) - len(strata)] if strata else []
    freedom += [trainings[k] - 1 for k in sides]
    low, high = _ends(result.bootstrap_distribution, _tail(min(freedom), max(1, len(strata))))
    return Intervals(value, low, high, resamples)


def run_weights(drives: Array, trainings: Array) -> Array:
    """Return how often each run is drawn, (resamples, trainings x drives), from those of both."""
    weights: Array = (trainings[:, :, None] * drives[:, None, :]).reshape(len(drives), -1)
    return weights


def _counts(drawn: Array, number: int) -> Array:
    """Return how often each of `number` units was drawn in each row, (resamples, number)."""
    rows = number * np.arange(len(drawn))[:, None]
    return np.bincount((drawn + rows).ravel(), minlength=number * len(drawn)).reshape(-1, number)


def _tail(freedom: int, strata: int) -> float:
    """Return the share of resamples beyond each end of an expanded percentile interval.

    Percentiles of a mean's resamples lack the t-distribution's width and the factor sqrt(n / (n -
    1)) of a variance: of ten drives they cover 90 %, not 95 %. Taken further out, they cover what
    they say (Hesterberg, The American Statistician 69, 2015, 371-386). `freedom` is the number of
    units less that of strata; of trainings and drives, the smaller one.
    """
    factor = np.sqrt((freedom + strata) / freedom)
    return float(norm.cdf(factor * student.ppf((1.0 - CONFIDENCE) / 2.0, freedom)))


def _ends(drawn: Array, tail: float) -> tuple[Array, Array]:
    """Return the ends of the percentile interval of each row; inf is the largest, NaN left out.

    They are order statistics, never between two of them: halfway to inf is no number.
    """
    ordered = np.sort(drawn, axis=1)
    last = (~np.isnan(ordered)).sum(axis=1) - 1
    rows = np.arange(len(ordered))
    low = ordered[rows, np.floor(tail * last).astype(int)]
    high = ordered[rows, np.ceil((1.0 - tail) * last).astype(int)]
    return low, high
