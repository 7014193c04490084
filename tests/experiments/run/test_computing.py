"""Computing times as delays."""

from typing import Any

import numpy as np
import pytest

from experiments.run.case import Case, run_case
from experiments.run.computing import ARRANGEMENTS, ComputingTimes, quantiles

PERIOD = 0.02


def times(arrangement: str, **changes: Any) -> ComputingTimes:
    given = {"estimation": 0.004, "control": 0.006, "mailbox": 1e-4, "period": PERIOD, **changes}
    return ComputingTimes(arrangement, **given)


def test_what_each_arrangement_adds_up_to() -> None:
    assert times("sequential")(0, 1.0) == (pytest.approx(0.010), pytest.approx(0.010))
    assert times("triggered")(0, 1.0) == (pytest.approx(0.0101), pytest.approx(0.006))
    free = times("free-running")
    latencies, occupied = np.array([free(k, 1.0) for k in range(4000)]).T
    assert set(occupied) == {0.006}
    # The wait is uniform over a period.
    wait = latencies - 0.0101
    assert wait.min() >= 0.0
    assert wait.max() <= PERIOD
    assert wait.mean() == pytest.approx(0.5 * PERIOD, abs=4.0 * PERIOD / np.sqrt(12 * 4000))


def test_a_slower_computer_takes_longer() -> None:
    assert times("sequential", load=3.0)(0, 1.0)[0] == pytest.approx(0.030)
    # It waits for its estimator, where that takes longer than a period.
    slow = times("free-running", estimation=0.03, control=0.0, mailbox=0.0)
    assert max(slow(k, 0.0)[0] for k in range(2000)) == pytest.approx(0.06, rel=0.01)


def test_draws_follow_the_recorded_distribution() -> None:
    rng = np.random.default_rng(0)
    recorded = rng.gamma(3.0, 0.001, 20000)
    drawn = times("sequential", estimation=0.0, control=quantiles(recorded))
    values = np.array([drawn(k, 0.0)[0] for k in range(20000)])
    for share in (0.05, 0.5, 0.95):
        assert np.quantile(values, share) == pytest.approx(np.quantile(recorded, share), rel=0.05)
    told = drawn.summary()
    assert told["median"] == np.median(values)
    assert told["max"] == values.max()


def test_measured_times_are_those_of_the_agent() -> None:
    assert times("sequential", control="measured", load=2.0)(0, 0.005)[0] == pytest.approx(0.018)


def test_the_same_seed_draws_the_same() -> None:
    spread = [0.001, 0.002, 0.009]
    one, other, third = (
        times("triggered", estimation=spread, control=spread, seed=seed) for seed in (1, 1, 2)
    )
    first = [one(k, 0.0) for k in range(5)]
    assert first == [other(k, 0.0) for k in range(5)]
    assert first != [third(k, 0.0) for k in range(5)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arrangement": "parallel"}, "unknown arrangement 'parallel'.*triggered"),
        ({"control": "recorded"}, "or 'measured'"),
        ({"control": [0.1, np.nan]}, "control times must be finite"),
        ({"estimation": [-0.1]}, "estimation times must be"),
        ({"estimation": []}, "estimation times must be"),
        ({"load": 0.0}, "load must be positive"),
    ],
)
def test_errors(changes: dict[str, Any], message: str) -> None:
    given = {"arrangement": "sequential", **changes}
    with pytest.raises(ValueError, match=message):
        times(**given)


def case(arrangement: str, **changes: Any) -> dict[str, Any]:
    return {
        "agent": "stanley", "trajectory": "T2", "conditions": "ideal", "control_period": PERIOD,
        "env_settings": {"time_limit": 4.0, "preview_period": 0.05},
        "computing": {"arrangement": arrangement, "estimation": 0.01, "control": 0.014, **changes},
    }  # fmt: skip


def test_a_case_of_them_is_driven_and_told() -> None:
    """24 ms for a clock of 20: in sequence every second period is missed, in parallel none."""
    results = {name: run_case(case(name)) for name in ARRANGEMENTS}
    assert {result["status"] for result in results.values()} == {"ok"}
    missed = {name: result["metrics"]["deadline_misses"] for name, result in results.items()}
    assert missed == {"sequential": 100, "triggered": 0, "free-running": 0}
    # An agent that is busy is not asked: its time is that of the periods in which it was.
    asked = {
        name: np.count_nonzero(result["trace"]["solve_time"]) for name, result in results.items()
    }
    assert asked == {"sequential": 100, "triggered": 200, "free-running": 200}
    assert results["sequential"]["latency"]["median"] == pytest.approx(0.024)
    assert results["free-running"]["latency"]["median"] > 0.03


def test_recorded_times_are_repeated_exactly() -> None:
    spec = case("triggered", control=[0.004, 0.008, 0.03])
    first, again = run_case(spec), run_case(spec)
    assert first["latency"] == again["latency"]
    np.testing.assert_array_equal(first["trace"]["state"], again["trace"]["state"])


def test_ideal_conditions_have_no_delays() -> None:
    with pytest.raises(ValueError, match="conditions 'simulation' have not"):
        Case(**{**case("sequential"), "conditions": "simulation"}).check()
