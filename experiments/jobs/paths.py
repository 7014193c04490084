"""Paths and seeds for training, validation and evaluation, which never overlap."""

from collections.abc import Callable, Sequence

import trajectories
from experiments.run.suites import HELD_OUT, SIX
from trajectories import ReferencePath

# Random paths with smaller seeds are left for evaluation.
TRAINING_PATHS, VALIDATION_PATHS = 10_000_000, 20_000_000
MOST_PATHS = 1000
"""Largest number of random paths for one seed of a job: the next seed's paths follow them."""
# Seeds of episodes: evaluation counts from 0. Under one seed, a vehicle meets the same disturbances
# on every path.
VALIDATION_EPISODES, TRAINING_EPISODES = 2 * 10**8, 10**9


def random_names(first: int, count: int) -> list[str]:
    """Return names of random paths with seeds from `first` on, slow and fast ones in turn."""
    return [f"random-{'fast-' * (k % 2)}{first + k}" for k in range(count)]


def training_names(own: Sequence[str], seed: int, count: int) -> list[str]:
    """Return the user's own paths, or else the random ones that belong to a job's seed."""
    return list(own) or random_names(TRAINING_PATHS + MOST_PATHS * seed, count)


def episode_seed(seed: int, number: int) -> int:
    """Return the seed of the first episode in step `number` of a job; the others count on."""
    return TRAINING_EPISODES * (1 + seed) + 1_000_000 * number


def load_paths(
    names: Sequence[str], tick: Callable[[int, int], None] = lambda *_: None
) -> list[ReferencePath]:
    """Load paths; `tick(done, all)` is called after each."""
    paths = []
    for k, name in enumerate(names):
        paths.append(trajectories.load(name))
        tick(k + 1, len(names))
    return paths


def check_paths(own: Sequence[str], count: int, seed: int, *, verb: str) -> None:
    """Refuse paths of the evaluation, more random paths than a seed has, and a wrong seed.

    Raises
    ------
    ValueError
        Naming what is wrong; `verb` is "train" or "tune".
    """
    if count > MOST_PATHS:
        raise ValueError(f"paths must be at most {MOST_PATHS}, not {count}")
    if not 0 <= seed < 1000:
        raise ValueError(f"seed must be in [0, 999], not {seed}")
    for name in own:
        if name.removesuffix("-raw") in (*SIX, *HELD_OUT):
            raise ValueError(f"{name} is for evaluation: {verb} on other paths")
