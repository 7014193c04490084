"""How episodes begin: counter-based random draws and the memory they lead to.

An environment holds one random 64-bit key. Every draw is a hash of (key, episode number, what is
drawn), by the mixing function of splitmix64 (Steele, Lea, Flood 2014), so an episode does not
depend on how many environments there are, on which of them reset before, or on what else was drawn.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import PSI, VX, X, Y
from trajectories.compilation import compiled, compiled_internal
from trajectories.interpolation import heading_at, position_at, speed_at

Array = NDArray[Any]

TRAJECTORY_DRAW, VEHICLE_DRAW, START_DRAW, LATERAL_DRAW, HEADING_DRAW, SPEED_DRAW = range(6)
"""Number of each draw within an episode."""

GIVEN = ("arc_length", "lateral_error", "heading_error", "speed_error")
"""What `begin` takes instead of drawing it, in this order; NaN is drawn."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_FACTOR, SECOND_FACTOR = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11))
ROLLING_DECELERATION = 6
"""Index of mu g in the constants."""


def random_key(generator: np.random.Generator) -> np.uint64:
    """Key of the episodes that follow a seed, uint64."""
    return generator.integers(0, 2**64, dtype=np.uint64)


def given_start(options: Mapping[str, Any], length: float) -> NDArray[np.float64]:
    """Start that reset options ask for, (4,) in the order of `GIVEN`, NaN where they do not.

    Raises
    ------
    ValueError
        For a value that is not a finite number, or an arc length outside of the path.
    """
    start = np.full(len(GIVEN), math.nan)
    for k, key in enumerate(GIVEN):
        if key not in options:
            continue
        try:
            value = float(options[key])
        except (TypeError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"reset option {key} must be a finite number, not {options[key]!r}")
        if key == "arc_length" and not 0.0 <= value <= length:
            raise ValueError(f"option arc_length must be in [0, {length:.2f}] m, not {value}")
        start[k] = value
    return start


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
def error(given: Any, half: Any, key: Any, episode: Any, draw: int) -> Any:
    """Initial error: as given, or uniform within +-half."""
    if not math.isnan(given):
        return given
    return half * (2.0 * uniform(key, episode, draw) - 1.0)


@compiled
def begin(
    memory: Array, constants: Array, table: Array, observation: Array,
    key: Any, episode: Any, given: Array,
) -> None:  # fmt: skip
    """Begin an episode: draw what is not given, set the state, write memory and observation.

    `given`, shape (4,), as `GIVEN` lists it: m, m, rad, m/s.
    """
    p = constants
    s = given[0]
    if math.isnan(s):
        s = p[kernels.START_RANGE] * uniform(key, episode, START_DRAW)
    lateral_error = error(given[1], p[kernels.LATERAL_RANGE], key, episode, LATERAL_DRAW)
    heading_error = error(given[2], p[kernels.HEADING_RANGE], key, episode, HEADING_DRAW)
    speed_error = error(given[3], p[kernels.SPEED_RANGE], key, episode, SPEED_DRAW)
    length, closed = p[kernels.LENGTH], p[kernels.CLOSED] > 0.5
    heading = heading_at(table, length, closed, s)
    x, y = position_at(table, length, closed, s)
    memory[:] = 0.0
    memory[VX] = speed_at(table, length, closed, s) + speed_error
    memory[PSI] = heading + heading_error
    memory[X] = x - lateral_error * math.sin(heading)
    memory[Y] = y + lateral_error * math.cos(heading)
    memory[kernels.ACCELERATION] = p[ROLLING_DECELERATION]
    memory[kernels.ARC_LENGTH] = s
    kernels.start(memory, p, table, observation)
