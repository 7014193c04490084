"""Statistics of few trainings against known answers, and what an oracle could gain."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom, binomtest

from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.score import scores_of
from agents.weights import TrackingWeights
from experiments.run import statistics
from experiments.run.statistics import interquartile_mean, mean_interval, paired_gain, rate_bound
from experiments.study import oracle
from experiments.study.evaluation import EvaluationSet
from experiments.study.oracle import greedy, headroom, loop_of, pool_of, scores_of_pool, varied
from lpv_track_env.vector_env import PathTrackingVectorEnv

Array = NDArray[Any]


def test_interquartile_mean_is_that_of_the_middle_half() -> None:
    assert interquartile_mean(np.array([100.0, 2.0, 1.0, -50.0])) == 1.5
    assert interquartile_mean(np.array([8.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7e9])) == 4.5
    table = np.array([[9.0, 1.0], [2.0, 2.0], [3.0, 4.0], [-9.0, 99.0]])
    np.testing.assert_array_equal(interquartile_mean(table), [2.5, 3.0])
    np.testing.assert_array_equal(interquartile_mean(table, axis=1), table.mean(axis=1))


def test_a_gain_that_is_everywhere_the_same_is_certain() -> None:
    theirs = np.random.default_rng(0).uniform(1.0, 5.0, (10, 8, 4))
    found = paired_gain(0.75 * theirs, theirs)
    np.testing.assert_allclose([found.value, found.low, found.high], 0.25, rtol=1e-12)
    one, other = (mean_interval(theirs, seed=seed) for seed in (0, 1))
    assert one == mean_interval(theirs)
    assert one.value == other.value
    assert one.low != other.low


def test_a_gain_is_the_interquartile_mean_of_the_trainings_gains() -> None:
    # Of four trainings gains 0.1, 0.2, 0.4, -9: outliers at both ends do not count.
    theirs = np.full((4, 3, 2), 2.0)
    theirs[:, 1] = 4.0
    ours = theirs * (1.0 - np.array([0.1, 0.2, 0.4, -9.0]))[:, None, None]
    found = paired_gain(ours, theirs)
    assert found.value == pytest.approx(0.15)
    assert found.low < 0.15 < found.high <= 0.4 + 1e-12
    assert found == paired_gain(ours, theirs)
    with pytest.raises(ValueError, match="alike in shape"):
        paired_gain(ours, theirs[:3])
    with pytest.raises(ValueError, match="alike in shape"):
        paired_gain(ours[0], theirs[0])


def simulated(rng: np.random.Generator, gain: float) -> tuple[Array, Array]:
    """Ten trainings' scores on 20 paths: trainings, paths and drives all differ."""
    theirs = 3.0 + rng.uniform(0.0, 2.0, (1, 20, 1)) + rng.normal(0.0, 0.1, (10, 20, 4))
    factor = 1.0 - gain + rng.normal(0.0, 0.03, (10, 1, 1)) + rng.normal(0.0, 0.04, (1, 20, 1))
    return factor * theirs + rng.normal(0.0, 0.1, (10, 20, 4)), theirs


def test_intervals_cover_the_truth_as_often_as_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 300)
    rng, studies, gain = np.random.default_rng(0), 200, 0.2
    covered = np.zeros(2)
    for _ in range(studies):
        ours, theirs = simulated(rng, gain)
        one, other = paired_gain(ours, theirs), mean_interval(theirs)
        covered += one.low <= gain <= one.high, other.low <= 4.0 <= other.high
    # A bootstrap of ten trainings is a little narrow; nearly never would it be this far off.
    low, high = binom.ppf([1e-3, 1 - 1e-3], studies, [0.90, 0.97])
    assert (covered >= low).all(), covered
    assert (covered <= high).all(), covered


@pytest.mark.parametrize(("failures", "drives"), [(0, 1), (0, 300), (1, 10), (7, 40), (40, 40)])
def test_rate_bounds_are_clopper_and_pearsons(failures: int, drives: int) -> None:
    exact = binomtest(failures, drives, alternative="less").proportion_ci(0.95, method="exact")
    assert rate_bound(failures, drives) == pytest.approx(exact.high, rel=1e-12)


def test_failures_that_make_no_rate_are_refused() -> None:
    assert rate_bound(0, 300) == pytest.approx(1.0 - 0.05 ** (1 / 300))
    for failures, drives in ((-1, 3), (4, 3), (0, 0)):
        with pytest.raises(ValueError, match="make no rate"):
            rate_bound(failures, drives)


# What an oracle could gain -----------------------------------------------------------------------


def told(scores: Array, known: Array) -> dict[str, tuple[float, float | None]]:
    return {one.knows: (one.hindsight, one.foresight) for one in headroom(scores, known)}


def test_headroom_of_made_scores() -> None:
    # Two paths, three sets, four seeds. Set 1 is best on path 0, set 2 on path 1.
    scores = np.array([[2.0, 1.0, 4.0], [2.0, 4.0, 1.0]])[:, :, None] * np.ones((2, 3, 4))
    known = np.zeros((2, 4, 3))
    found = told(scores, known)
    nothing, path, conditions, drive = found
    assert found[nothing] == (2.0, 2.0)
    assert found[path] == (1.0, 1.0)
    # Nothing differs in the conditions: to know them is to know nothing.
    assert found[conditions] == (2.0, 2.0)
    assert found[drive] == (1.0, None)
    fixed, by_path, *_ = headroom(scores, known)
    assert by_path.gain(fixed.hindsight) == 0.5


def test_headroom_of_knowing_the_conditions() -> None:
    # Set 1 is best in much noise, set 0 in little: seeds 2 and 3 are noisy.
    scores = np.array([[1.0, 1.0, 5.0, 5.0], [3.0, 3.0, 2.0, 2.0]])[None]
    known = np.zeros((1, 4, 3))
    known[0, :, 0] = [0.01, 0.02, 0.3, 0.4]
    (nothing, _, conditions, drive), found = told(scores, known), told(scores, known)
    assert found[nothing][0] == 2.5
    assert found[conditions] == (1.5, 1.5)
    assert found[drive] == (1.5, None)


def test_foresight_has_no_luck() -> None:
    # Pure noise: in hindsight the best of 20 sets looks good, by foresight it is an average one.
    rng = np.random.default_rng(0)
    scores, known = rng.normal(10.0, 1.0, (12, 20, 16)), rng.uniform(size=(12, 16, 3))
    for hindsight, foresight in list(told(scores, known).values())[1:3]:
        assert hindsight < 9.7
        assert foresight == pytest.approx(10.0, abs=4.0 / np.sqrt(12 * 16))


def test_foresight_never_chooses_on_the_drives_that_it_is_scored_on() -> None:
    # One noisy drive, seed 0, where set 1 shines: on no other noisy drive could that be learned.
    scores = np.full((1, 2, 3), 2.0)
    scores[0, 1] = [0.0, 9.0, 9.0]
    known = np.zeros((1, 3, 3))
    known[0, 0] = 1.0
    *_, conditions, _ = told(scores, known).values()
    # In hindsight (0 + 2 + 2) / 3. By foresight seed 0 takes set 0, which is best on seed 1.
    assert conditions[0] == pytest.approx(4.0 / 3.0)
    assert conditions[1] == pytest.approx((2.0 + 2.0 + 2.0) / 3.0)
    # One seed leaves none to choose on.
    assert all(ahead is None for _, ahead in told(scores[..., :1], known[:, :1]).values())


def test_varied_sets_complement_one_another() -> None:
    # Set 0 is good on seed 0, set 1 better on seed 1, set 2 middling everywhere.
    scores = np.array([[[1.0, 9.0, 9.0], [9.0, 0.0, 9.0], [4.0, 4.0, 4.0]]])
    assert varied(scores, 2) == [2, 1]
    assert varied(scores, 9) == [2, 1, 0]


def test_a_pool_holds_the_default_set_what_was_found_and_a_sequence() -> None:
    found = [TrackingWeights(Q=(9.0, 9.0, 9.0, 9.0))]
    pool = pool_of(64, found)
    assert pool.shape == (66, 12)
    default = TrackingWeights().as_array()
    np.testing.assert_array_equal(pool[:2], [default, found[0].as_array()])
    factors = np.log(pool[2:] / default) / np.log(100.0)
    np.testing.assert_allclose(factors[:, 8:], 0.0, atol=1e-12)
    assert np.abs(factors).max() <= 1.0 + 1e-12
    np.testing.assert_allclose(factors[:, :8].mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_array_equal(pool_of(64, found), pool)


SMALL = EvaluationSet(
    "small", ("circle", "figure-eight"), "realtime", 2, env_settings={"time_limit": 3.0}
)
POOL = pool_of(2, [])


def test_a_greedy_oracle_of_one_set_is_that_set() -> None:
    fixed = [scores[0] for scores, _ in scores_of_pool(SMALL, POOL[1:2])]
    np.testing.assert_allclose(list(greedy(SMALL, POOL[1:2])), fixed, rtol=1e-9)


def test_copies_do_not_disturb_the_drives_that_are_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    window, n = 8, SMALL.seeds
    drive = ClosedLoop.drive
    choices: list[Array] = []
    marks: list[int] = []

    def watched(loop: ClosedLoop, periods: int, weights: Any = None, **named: Any) -> Tally:
        if periods == window:
            choices.append(np.array(weights)[:n])
        return drive(loop, periods, weights, **named)

    monkeypatch.setattr(oracle.ClosedLoop, "drive", watched)
    scores = []
    for one in greedy(SMALL, POOL, window=window, ahead=2):
        scores.append(one)
        marks.append(len(choices))
    monkeypatch.undo()
    # It does choose, and otherwise for each drive.
    assert len({row.tobytes() for table in choices for row in table}) > 1
    for k, path in enumerate(SMALL.trajectories):
        envs = PathTrackingVectorEnv(
            n, path, conditions="realtime", autoreset_mode="Disabled", time_limit=3.0
        )
        loop = loop_of(envs)
        loop.reset(seed=0)
        sums = np.zeros((len(Tally._fields), n))
        for tables in choices[([0, *marks])[k] : marks[k]]:
            sums += np.array(loop.drive(window, tables))
        assert not loop.running.any()
        np.testing.assert_array_equal(scores_of(Tally(*sums), envs.arrays.ends), scores[k])
