"""Counter-based random numbers: every draw is a hash of (key, episode number, what is drawn).

By the mixing function of splitmix64 (Steele, Lea, Flood 2014). What is drawn depends on nothing
else: not on how many environments there are, nor on their order or threads.
"""

import math
from typing import Any

import numpy as np

from trajectories.compilation import compiled_internal

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_FACTOR, SECOND_FACTOR = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11))


def random_key(generator: np.random.Generator) -> np.uint64:
    """Key of the episodes that follow a seed, uint64."""
    return generator.integers(0, 2**64, dtype=np.uint64)


@compiled_internal
def mix(z: Any) -> Any:
    """Finaliser of splitmix64: a bijection of 64-bit numbers that scatters them."""
    z = (z ^ (z >> SHIFTS[0])) * FIRST_FACTOR
    z = (z ^ (z >> SHIFTS[1])) * SECOND_FACTOR
    return z ^ (z >> SHIFTS[2])


@compiled_internal
def uniform(key: Any, episode: Any, draw: int) -> Any:
    """Number in [0, 1) for a key (uint64), an episode (from 0) and a draw."""
    z = mix(key + GOLDEN * (np.uint64(episode) + np.uint64(1)))
    z = mix(z + GOLDEN * (np.uint64(draw) + np.uint64(1)))
    return np.float64(z >> SHIFTS[3]) * 2.0**-53


@compiled_internal
def choice(key: Any, episode: Any, draw: int, count: int) -> int:
    """One of `count` indices."""
    return min(int(uniform(key, episode, draw) * count), count - 1)


@compiled_internal
def gaussian(key: Any, episode: Any, draw: int) -> tuple[Any, Any]:
    """Two independent standard normal numbers for a draw and the one after it (Box, Muller)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(key, episode, draw)))
    angle = 2.0 * math.pi * uniform(key, episode, draw + 1)
    return radius * math.cos(angle), radius * math.sin(angle)
