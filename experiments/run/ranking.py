"""Ranking of agents over the regimes of a suite, drive by drive."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from experiments.run import regimes
from experiments.run.estimates import range_words
from experiments.run.statistics import CONFIDENCE, RESAMPLES, rate_interval
from experiments.run.tables import (
    Result,
    by_label,
    drive_of,
    training_of,
    with_trainings,
)

Array = NDArray[np.float64]

CLOSE = 1.05
"""Largest ratio to a regime's best figure that counts as among the best."""
HEADINGS = ("agent", "mean rank", "95 %", "among the best", "drives", "failed", "95 %")
NOTE = (
    "In every drive the agents are ranked: one that fails is behind all that pass, and those that "
    "pass by the first figure of their regime (MLE; from a start ALE; entry speed; fastest lap). "
    "The mean rank counts every regime alike, 1 being the best; its interval is a bootstrap over "
    "the drives of each regime. Among the best is an agent in a regime if none fails less often "
    "and its mean figure is within 5 % of the best of those that fail as rarely. An agent with "
    "several trainings has in every drive the mean rank of its trainings, each ranked among one "
    "training of every other agent, in all combinations; the bootstrap draws trainings, too. "
    "Its failed drives are those of all trainings, beside the range of the trainings' rates."
)
LARGER_IS_BETTER = ("highest_fixed_speed",)
"""First figures of a regime of which the largest is the best."""


LEAST_RESAMPLES, MOST_DRAWN = 1000, 50_000_000
"""Fewest resamples, and most drives in all of them together: many drives get fewer resamples."""
MOST_AT_ONCE = 4_000_000
"""Most numbers that are in memory at once."""


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
    trainings: int = 0
    by_training: str = ""
    """Range of the trainings' rates of failures, if there are several."""

    @property
    def cells(self) -> list[str]:
        """Text of the columns of `HEADINGS`."""
        low, high = (100.0 * end for end in rate_interval(self.failed, self.drives))
        interval = f"{low:.1f} to {high:.1f} %"
        if self.by_training:
            interval += f", {self.by_training}"
        return [
            with_trainings(self.label, self.trainings), f"{self.rank:.2f}",
            f"{self.low:.2f} to {self.high:.2f}", f"{self.among_best} of {self.regimes}",
            f"{self.drives}", f"{self.failed}", interval,
        ]  # fmt: skip


Entry = tuple[str, int | None]
"""Name of an agent, and one of its training seeds."""


def ranking(cases: Iterable[Result], *, seed: int = 0) -> list[Place]:
    """Rank the agents of cases that have regimes, the best first; `seed` is the bootstrap's.

    Drives that not all agents have, with all their trainings, are left out, so that every agent is
    ranked on the same ones.
    """
    return ranked([by_label(group) for group in regimes.by_regime(cases).values()], seed=seed)


def ranked(groups: Sequence[Mapping[str, Sequence[Result]]], *, seed: int = 0) -> list[Place]:
    """Rank agents over groups of drives, which count alike: the cases of each agent by its name."""
    names = list(dict.fromkeys(name for group in groups for name in group))
    entries = sorted(
        {(name, training_of(case)) for group in groups for name in group for case in group[name]},
        key=lambda one: (names.index(one[0]), -1 if one[1] is None else one[1]),
    )
    losses = [found for group in groups if len(found := _losses(group, entries))]
    if not losses:
        return []
    agents = np.array([names.index(name) for name, _ in entries])
    trainings = np.bincount(agents)
    random = np.random.default_rng(seed)
    if len(entries) == len(names):
        mean, drawn = _mean_ranks(losses, random)
    else:
        mean, drawn = _expected_ranks(losses, agents, random)
    low, high = np.quantile(drawn, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], axis=0)
    best = np.sum([_among_best(found, agents) for found in losses], axis=0)
    failed = np.sum([np.isinf(found).sum(axis=0) for found in losses], axis=0)
    drives = sum(len(found) for found in losses)
    places = []
    for k, name in enumerate(names):
        own = failed[agents == k]
        by_training = range_words(100.0 * own / drives) if trainings[k] > 1 else ""
        places.append(
            Place(
                name, float(mean[k]), float(low[k]), float(high[k]), int(best[k]), len(losses),
                drives * int(trainings[k]), int(own.sum()), int(trainings[k]), by_training,
            )
        )  # fmt: skip
    return sorted(places, key=lambda place: (place.rank, place.label))


def _losses(group: Mapping[str, Sequence[Result]], entries: Sequence[Entry]) -> Array:
    """Return the loss of every entry in every drive that all have, (drives, entries).

    The loss is the first figure of the regime, or 1 over it where larger is better; inf in a drive
    that failed.
    """
    column = regimes.columns_of(case for cases in group.values() for case in cases)[0]
    found: dict[str, dict[Entry, float]] = {}
    for name, cases in group.items():
        for case in cases:
            figure = regimes.figure(case, column) if regimes.passed(case) else None
            if figure is not None and column.key in LARGER_IS_BETTER:
                figure = 1.0 / figure if figure > 0.0 else None
            drive = found.setdefault(drive_of(case), {})
            drive[name, training_of(case)] = np.inf if figure is None else figure
    shared = [drive for drive in found.values() if len(drive) == len(entries)]
    whole = [[drive[entry] for entry in entries] for drive in shared]
    return np.array(whole, dtype=np.float64).reshape(-1, len(entries))


def _mean_ranks(losses: Sequence[Array], random: np.random.Generator) -> tuple[Array, Array]:
    """Return mean ranks over groups, (agents,), and those of resamples, (resamples, agents)."""
    ranks = [rankdata(found, axis=1) for found in losses]
    resamples = _resamples(max(map(len, ranks)))
    drawn = [
        np.concatenate([counts @ found for counts in _drawn(len(found), random, resamples)])
        for found in ranks
    ]
    return np.mean([found.mean(axis=0) for found in ranks], axis=0), np.mean(drawn, axis=0)


def _expected_ranks(
    losses: Sequence[Array], agents: NDArray[np.int64], random: np.random.Generator
) -> tuple[Array, Array]:
    """Return what `_mean_ranks` does for several trainings; `agents` has the agent of each entry.

    The rank among one training of every other agent is 1 plus the number of those ahead, so that
    its mean over all combinations of trainings is 1 plus a sum over pairs.
    """
    member = (agents == np.arange(agents[-1] + 1)[:, None]).astype(np.float64)
    even = member / member.sum(axis=1, keepdims=True)
    resamples = _resamples(max(map(len, losses)) * len(agents))
    # The trainings that are drawn are the same in all groups.
    shares = np.zeros((resamples, *member.shape))
    for k, own in enumerate(member.astype(bool)):
        shares[:, k, own] = np.concatenate([*_drawn(int(own.sum()), random, resamples)])
    mean, drawn = np.zeros(len(member)), np.zeros((resamples, len(member)))
    for found in losses:
        ahead = _ahead(found, agents)
        mean += _expected(ahead.mean(axis=0)[None], even[None])[0] / len(losses)
        first = 0
        for counts in _drawn(len(found), random, resamples, least=agents.size**2):
            block = slice(first, first := first + len(counts))
            rates = np.tensordot(counts, ahead, axes=1)
            drawn[block] += _expected(rates, shares[block]) / len(losses)
    return mean, drawn


def _ahead(losses: Array, agents: NDArray[np.int64]) -> Array:
    """Return how far entry f is ahead of entry e in each drive, (drives, e, f).

    It is 1 for a lower loss, 0.5 for an equal one, and 0 among the entries of one agent.
    """
    mine, others = losses[:, :, None], losses[:, None, :]
    ahead: Array = (others < mine) + 0.5 * (others == mine)
    ahead[:, agents[:, None] == agents] = 0.0
    return ahead


def _expected(rates: Array, shares: Array) -> Array:
    """Return mean ranks (n, agents) for means (n, e, f) of `_ahead` over drives.

    `shares` (n, agents, entries) are the shares of each agent's trainings.
    """
    ahead = np.einsum("nef,nf->ne", rates, shares.sum(axis=1))
    ranks: Array = 1.0 + np.einsum("nke,ne->nk", shares, ahead)
    return ranks


def _resamples(size: int) -> int:
    """Return the number of resamples for a group of so many drives."""
    return min(RESAMPLES, max(LEAST_RESAMPLES, MOST_DRAWN // size))


def _drawn(
    size: int, random: np.random.Generator, resamples: int, *, least: int = 1
) -> Iterator[Array]:
    """Yield the share of each of `size` drives in resamples, (n, size); the n sum to `resamples`.

    `least` is the size of what else is in memory for each resample.
    """
    even = np.full(size, 1.0 / size)
    step = max(1, MOST_AT_ONCE // max(size, least))
    for done in range(0, resamples, step):
        yield random.multinomial(size, even, min(step, resamples - done)) / size


def _among_best(losses: Array, agents: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which agents are among the best of a regime, over all their trainings, (agents,)."""
    passed = np.isfinite(losses)
    counts = np.bincount(agents, passed.sum(axis=0))
    sums = np.bincount(agents, np.where(passed, losses, 0.0).sum(axis=0))
    means = np.divide(sums, counts, out=np.full(len(counts), np.inf), where=counts > 0)
    shares = counts / np.bincount(agents)
    rarest = shares == shares.max()
    found: NDArray[np.bool_] = rarest & (means <= CLOSE * means[rarest].min()) & (counts > 0)
    return found
