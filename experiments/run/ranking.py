"""Ranking of agents over the regimes of a suite, drive by drive."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from experiments.run import regimes
from experiments.run.statistics import CONFIDENCE, RESAMPLES, rate_interval
from experiments.run.tables import Result, by_label, drive_of

Array = NDArray[np.float64]

CLOSE = 1.05
"""Largest ratio to a regime's best figure that counts as among the best."""
HEADINGS = ("agent", "mean rank", "95 %", "among the best", "drives", "failed", "95 %")
NOTE = (
    "In every drive the agents are ranked: one that fails is behind all that pass, and those that "
    "pass by the first figure of their regime (MLE; from a start ALE; entry speed; fastest lap). "
    "The mean rank counts every regime alike, 1 being the best; its interval is a bootstrap over "
    "the drives of each regime. Among the best is an agent in a regime if none fails less often "
    "and its mean figure is within 5 % of the best of those that fail as rarely."
)
LARGER_IS_BETTER = ("highest_fixed_speed",)
"""First figures of a regime of which the largest is the best."""


LEAST_RESAMPLES, MOST_DRAWN = 1000, 50_000_000
"""Of many drives fewer resamples are drawn, so that all of them have at most so many drives."""
MOST_AT_ONCE = 4_000_000
"""Most counts that are in memory at once."""


class Place(NamedTuple):
    """An agent's mean rank and its interval, regimes among the best, drives that failed."""

    label: str
    rank: float
    low: float
    high: float
    among_best: int
    regimes: int
    drives: int
    failed: int

    @property
    def cells(self) -> list[str]:
        """Text of the columns of `HEADINGS`."""
        low, high = (100.0 * end for end in rate_interval(self.failed, self.drives))
        return [
            self.label, f"{self.rank:.2f}", f"{self.low:.2f} to {self.high:.2f}",
            f"{self.among_best} of {self.regimes}", f"{self.drives}", f"{self.failed}",
            f"{low:.1f} to {high:.1f} %",
        ]  # fmt: skip


def ranking(cases: Iterable[Result], *, seed: int = 0) -> list[Place]:
    """Rank the agents of cases that have regimes, the best first; `seed` is the bootstrap's.

    Drives that not all agents have are left out, so that every agent is ranked on the same ones.
    """
    return ranked([by_label(group) for group in regimes.by_regime(cases).values()], seed=seed)


def ranked(groups: Sequence[Mapping[str, Sequence[Result]]], *, seed: int = 0) -> list[Place]:
    """Rank entries, such as agents, over groups of drives: the cases of each entry by its name.

    Every group counts alike. Of several results of an entry in one drive, as several trainings of
    one agent have them, the median counts.
    """
    names = list(dict.fromkeys(name for group in groups for name in group))
    losses = [found for group in groups if len(found := _losses(group, names))]
    if not losses:
        return []
    ranks = [rankdata(found, axis=1) for found in losses]
    random = np.random.default_rng(seed)
    resamples = min(RESAMPLES, max(LEAST_RESAMPLES, MOST_DRAWN // max(map(len, ranks))))
    drawn = np.mean(
        [_resampled_means(found, random, resamples) for found in ranks], axis=0
    )  # (resamples, entries)
    low, high = np.quantile(drawn, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], axis=0)
    mean = np.mean([found.mean(axis=0) for found in ranks], axis=0)
    best = np.sum([_among_best(found) for found in losses], axis=0)
    failed = np.sum([np.isinf(found).sum(axis=0) for found in losses], axis=0)
    drives = sum(len(found) for found in losses)
    places = [
        Place(
            name, float(mean[k]), float(low[k]), float(high[k]), int(best[k]), len(losses), drives,
            int(failed[k]),
        )
        for k, name in enumerate(names)
    ]  # fmt: skip
    return sorted(places, key=lambda place: (place.rank, place.label))


def _losses(group: Mapping[str, Sequence[Result]], names: Sequence[str]) -> Array:
    """Return the loss of every entry in every drive that all have, (drives, entries).

    The loss is the first figure of the regime, or 1 over it where larger is better; inf in a drive
    that failed.
    """
    column = regimes.columns_of(case for cases in group.values() for case in cases)[0]
    found: dict[str, dict[str, list[float]]] = {}
    for name, cases in group.items():
        for case in cases:
            figure = regimes.figure(case, column) if regimes.passed(case) else None
            if figure is not None and column.key in LARGER_IS_BETTER:
                figure = 1.0 / figure if figure > 0.0 else None
            drive = found.setdefault(drive_of(case), {})
            drive.setdefault(name, []).append(np.inf if figure is None else figure)
    shared = [drive for drive in found.values() if len(drive) == len(names)]
    whole = [[float(np.median(drive[name])) for name in names] for drive in shared]
    return np.array(whole, dtype=np.float64).reshape(-1, len(names))


def _resampled_means(ranks: Array, random: np.random.Generator, resamples: int) -> Array:
    """Return mean ranks of resampled drives, (resamples, entries).

    A resample counts how often each drive is drawn.
    """
    drives = len(ranks)
    even = np.full(drives, 1.0 / drives)
    step = max(1, MOST_AT_ONCE // drives)
    sizes = [min(step, resamples - done) for done in range(0, resamples, step)]
    means: Array = np.concatenate(
        [random.multinomial(drives, even, size) @ ranks / drives for size in sizes]
    )
    return means


def _among_best(losses: Array) -> NDArray[np.bool_]:
    """Return which agents are among the best of a regime, (agents,)."""
    passed = np.isfinite(losses)
    counts = passed.sum(axis=0)
    sums = np.where(passed, losses, 0.0).sum(axis=0)
    means = np.divide(sums, counts, out=np.full(len(counts), np.inf), where=counts > 0)
    rarest = counts == counts.max()
    found: NDArray[np.bool_] = rarest & (means <= CLOSE * means[rarest].min()) & (counts > 0)
    return found
