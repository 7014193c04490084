"""The real-time NMPC on observations of every kind: a status for each, and an action to drive."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from agents.nmpc.problem import Status
from agents.weights import TrackingWeights
from experiments.run.suites import PAPER_VEHICLES
from experiments.speed.solvers import wild_observations
from tests.helpers.driven_vehicles import drives, environment, made
from tests.helpers.nmpc_situations import WEIGHTS

MAX_ITERATIONS = 44
"""Turns of both methods, with a last try to end in a guess."""


@pytest.mark.parametrize("friction", ["linear", "estimated", 0.05, 0.3, 1.0])
@pytest.mark.parametrize("vehicle", PAPER_VEHICLES)
def test_wild_observations(vehicle: str, friction: Any) -> None:
    """60,000 in all. What cannot be solved says so, and every action can be driven."""
    env = environment(vehicle=vehicle)
    agent, rng, n = made(env, friction=friction), np.random.default_rng(5), 1500
    statuses: Counter[str] = Counter()
    for _ in range(2):
        rows = wild_observations(rng, n, agent.task.layout.preview_steps)
        # Twice: without plans, and with plans that were made for something else.
        for cold in (True, False):
            rows = rows if cold else rows[rng.permutation(n)]
            actions, memory = agent.predict(rows, None, np.full(n, cold))
            assert np.isfinite(actions).all()
            assert (actions >= env.action_space.low).all()  # type: ignore[attr-defined]
            assert (actions <= env.action_space.high).all()  # type: ignore[attr-defined]
            finite = np.isfinite(rows).all(axis=1)
            for k in range(n):
                report = agent.diagnostics(memory[k])
                status = Status(report["status"])
                assert (status is Status.NAN) == (not finite[k])
                assert 0 <= report["iterations"] <= MAX_ITERATIONS
                assert (report["fallback"] == "") == (status is Status.SUCCESS)
                statuses[status.value] += 1
    solvable = statuses.total() - statuses["NAN"]
    assert statuses["NAN"] > 0.03 * statuses.total()
    assert statuses["SUCCESS"] > 0.999 * solvable, statuses


def test_nothing_of_a_wild_batch_stays_in_the_solver() -> None:
    """The workspace is shared by all rows: what one left there must not touch the next."""
    rng, rows = np.random.default_rng(6), drives(3, 1)[0]
    agent = made()
    wanted = agent.predict(rows)[0]
    agent.predict(wild_observations(rng, 300, 20))
    np.testing.assert_array_equal(agent.predict(rows, None, np.ones(3, dtype=bool))[0], wanted)
    mixed = np.insert(wild_observations(rng, 3, 20), [0, 1, 2], rows, axis=0)
    np.testing.assert_array_equal(agent.predict(mixed)[0][::2], wanted)


def test_actions_on_the_way_to_bounds_lie_in_the_action_space() -> None:
    """The bounds are float32's: rounding to it must not step over them."""
    env = environment()
    agent = made(env, weights=TrackingWeights.from_array(WEIGHTS * ([100.0] * 8 + [1e-3] * 4)))
    observation, _ = env.reset(options={"lateral_error": 3.0})
    rows = np.repeat(observation[None], 200, axis=0)
    rng = np.random.default_rng(7)
    rows[:, 3] = rng.choice([3.5, 3.4999998, 3.2, -6.0], 200)
    rows[:, 4] = rng.choice([-np.pi / 6, np.pi / 6, -0.51], 200)
    actions, _ = agent.predict(rows)
    for action in actions:
        assert env.action_space.contains(action)
    assert np.isclose(np.abs(actions[:, 1]), np.pi / 6).any()
