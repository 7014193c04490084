"""Counter-based draws: published values, uniformity, independence; and the starts they make."""

import math

import numpy as np
import pytest

from lpv_track_env import draws, episodes, kernels
from lpv_track_env.env import PathTrackingEnv

GOLDEN = 0x9E3779B97F4A7C15
# The first outputs of splitmix64 for the seed 1234567, as published with its reference code.
PUBLISHED = (
    6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431,
    16408922859458223821,
)  # fmt: skip


def test_mixing_function_is_that_of_splitmix64() -> None:
    for k, wanted in enumerate(PUBLISHED):
        state = (1234567 + (k + 1) * GOLDEN) % 2**64
        assert int(draws.mix(np.uint64(state))) == wanted


def drawn(key: int, count: int, draws_each: int = 6) -> np.ndarray:
    return np.array(
        [
            [draws.uniform(np.uint64(key), episode, draw) for draw in range(draws_each)]
            for episode in range(count)
        ]
    )


def test_draws_are_uniform_and_independent() -> None:
    values = np.concatenate([drawn(key, 500) for key in (0, 1, 2, 2**64 - 1)])
    assert values.min() >= 0.0
    assert values.max() < 1.0
    n = values.size
    # Five standard deviations: of a mean 1 / sqrt(12 n), of a count in ten bins, of a correlation.
    assert abs(values.mean() - 0.5) < 5.0 / math.sqrt(12.0 * n)
    counts = np.histogram(values, bins=10, range=(0.0, 1.0))[0]
    assert np.abs(counts - n / 10).max() < 5.0 * math.sqrt(n * 0.1 * 0.9)
    across = np.corrcoef(values.T) - np.eye(6)
    assert np.abs(across).max() < 5.0 / math.sqrt(len(values))
    along = np.corrcoef(values[1:, 0], values[:-1, 0])[0, 1]
    assert abs(along) < 5.0 / math.sqrt(len(values))
    # Neighbouring keys, episodes and draws have nothing to do with one another.
    assert len(np.unique(values)) == n


def test_choices_are_uniform() -> None:
    picks = [draws.choice(np.uint64(9), k, 0, 7) for k in range(7000)]
    counts = np.bincount(picks, minlength=7)
    assert counts.shape == (7,)
    assert np.abs(counts - 1000).max() < 5.0 * math.sqrt(7000 / 7 * 6 / 7)


def test_a_draw_is_not_moved_by_another() -> None:
    """Drawing the start as well, or giving an error, leaves the other errors as they were."""
    settings = {"trajectory": "straight", "initial_error_range": (0.5, 0.1, 1.0)}
    plain = PathTrackingEnv(**settings).reset(seed=3)[1]  # type: ignore[arg-type]
    drawn = PathTrackingEnv(**settings, random_start=True).reset(seed=3)[1]  # type: ignore[arg-type]
    given = PathTrackingEnv(**settings).reset(seed=3, options={"heading_error": 0.0})[1]  # type: ignore[arg-type]
    for other in (drawn, given):
        assert other["lateral_error"] == pytest.approx(plain["lateral_error"], abs=1e-12)
        assert other["speed_error"] == pytest.approx(plain["speed_error"], abs=1e-12)
    assert given["heading_error"] == 0.0


def test_start_lies_at_the_errors_asked_for() -> None:
    env = PathTrackingEnv("circle")
    record, observation = np.full(kernels.RECORD_SIZE, 7.0), np.zeros(48, np.float32)
    given = np.array([12.0, 0.5, -0.2, 1.5, math.nan])
    episodes.begin(
        record, env.task.constants(), env.path.table, observation,
        np.uint64(0), 0, given, math.inf,
    )  # fmt: skip
    radius = math.hypot(record[4], record[5] - 30.0)
    # Left of a circle that turns left is inside.
    assert radius == pytest.approx(29.5, abs=1e-9)
    assert record[2] == pytest.approx(12.0 / 30.0 - 0.2, abs=1e-9)
    assert record[0] == pytest.approx(float(env.path.sample(12.0).speed) + 1.5)
    assert record[kernels.ARC_LENGTH] == pytest.approx(12.0, abs=1e-9)
    assert record[kernels.START] == record[kernels.ARC_LENGTH]
    assert record[kernels.STEPS] == 0.0
    assert not record[[kernels.END, *range(kernels.CLIPPED, kernels.RECORD_SIZE)]].any()
