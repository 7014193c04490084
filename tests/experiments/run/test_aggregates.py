"""Aggregates of Agarwal et al. 2021 against values by hand and SciPy's own, and their bootstrap."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom, mannwhitneyu, norm, trim_mean, ttest_1samp

from experiments.run import resampling
from experiments.run.resampling import bootstrap_intervals, plan_of, run_weights
from experiments.run.statistics import (
    optimality_gap,
    paired_failures,
    performance_profile,
    probability_of_improvement,
    weighted_interquartile_mean,
)

Array = NDArray[Any]
inf = np.inf


def once(values: Array) -> Array:
    return np.ones((1, len(values)))


def improvement(ours: Any, theirs: Any, tasks: Any = None) -> float:
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    tasks = np.zeros(len(ours), int) if tasks is None else np.asarray(tasks)
    theirs_tasks = tasks if len(theirs) == len(tasks) else np.zeros(len(theirs), int)
    found = probability_of_improvement(
        ours, theirs, tasks, theirs_tasks, once(ours), once(theirs)
    )  # fmt: skip
    return float(found[0])


def test_the_interquartile_mean_of_draws_by_hand() -> None:
    values = np.array([5.0, 1.0, inf, 3.0])
    # 1, 3, 5, inf: 1 and inf are cut.
    assert weighted_interquartile_mean(values, once(values)).tolist() == [4.0]
    # 1, 1, 1, 3 -> 1, 1; 5, inf, inf, inf -> inf; five draws 1, 3, 3, 3, 5 lose floor(5/4) = 1
    # at each end.
    draws = np.array([[0, 3, 0, 1], [1, 0, 3, 0], [1, 1, 0, 3]], float)
    assert weighted_interquartile_mean(values, draws).tolist() == [1.0, inf, 3.0]


def test_the_interquartile_mean_is_scipys_trimmed_mean() -> None:
    rng = np.random.default_rng(0)
    for number in (1, 2, 3, 4, 7, 10, 41):
        values = rng.normal(size=number)
        counts = rng.multinomial(number, np.full(number, 1.0 / number), 5)
        expected = [trim_mean(np.repeat(values, row), 0.25) for row in counts]
        np.testing.assert_allclose(weighted_interquartile_mean(values, counts), expected)


def test_probability_of_improvement_by_hand() -> None:
    # Pairs (ours, theirs): 1<2, 1<3, 4>2, 4>3: half.
    assert improvement([1.0, 4.0], [2.0, 3.0]) == 0.5
    # 1<2, 1<inf, inf>2, inf=inf: (1 + 1 + 0 + 1/2) / 4.
    assert improvement([1.0, inf], [2.0, inf]) == 2.5 / 4
    # Tasks count alike, however many runs they have: task 0 has 1 of 1, task 1 has 1/2 of 4.
    assert improvement([1.0, 5.0, 5.0], [2.0, 5.0, 5.0], [0, 1, 1]) == (1.0 + 0.5) / 2
    # Across tasks nothing is compared.
    assert improvement([1.0, 9.0], [2.0, 8.0], [0, 1]) == 0.5


def test_probability_of_improvement_is_mann_and_whitneys_u() -> None:
    rng = np.random.default_rng(1)
    for n, m in ((1, 1), (3, 8), (40, 25)):
        ours, theirs = rng.integers(0, 9, n).astype(float), rng.integers(1, 9, m).astype(float)
        u = mannwhitneyu(theirs, ours).statistic
        found = probability_of_improvement(
            ours, theirs, np.zeros(n, int), np.zeros(m, int), once(ours), once(theirs)
        )
        np.testing.assert_allclose(found, u / (n * m))


def test_draws_of_runs_and_of_tasks() -> None:
    """Runs that are drawn twice count twice; so does a task that is drawn twice as a whole."""
    rng = np.random.default_rng(2)
    ours, theirs = rng.integers(0, 5, 12).astype(float), rng.integers(0, 5, 12).astype(float)
    tasks = np.repeat(np.arange(3), 4)
    counts = np.array([[2, 0, 1, 1, 0, 0, 4, 0, 1, 1, 1, 1]], float)
    found = probability_of_improvement(ours, theirs, tasks, tasks, counts, counts)
    repeated = counts[0].astype(int)
    expected = improvement(
        np.repeat(ours, repeated), np.repeat(theirs, repeated), np.repeat(tasks, repeated)
    )
    np.testing.assert_allclose(found, expected)
    # Tasks of one run each: 1, 0 and 1/2, drawn 2, 0 and 1 times.
    alone = np.arange(3)
    drawn = np.array([[2.0, 0.0, 1.0]])
    found = probability_of_improvement(
        np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, 3.0]), alone, alone, drawn, drawn
    )
    assert found.tolist() == [(2 * 1.0 + 0.5) / 3]


def test_optimality_gap_by_hand() -> None:
    # Scores 0.1 / 0.05 -> 1, 0.1 / 0.2 = 1/2, 0 for a failure, 1 for no loss at all.
    losses = np.array([0.05, 0.2, inf, 0.0])
    np.testing.assert_allclose(optimality_gap(losses, 0.1, once(losses)), [1.5 / 4])
    np.testing.assert_allclose(
        optimality_gap(losses, 0.1, np.array([[0, 1, 3, 0], [4, 0, 0, 0]])), [3.5 / 4, 0.0]
    )


def test_performance_profile_by_hand() -> None:
    losses = np.array([0.3, 0.1, inf, 0.2])
    levels = np.array([0.05, 0.1, 0.25, 9.0])
    found = performance_profile(losses, levels, np.array([[1, 1, 1, 1], [0, 2, 2, 0]]))
    assert found.T.tolist() == [[0.0, 0.25, 0.5, 0.75], [0.0, 0.5, 0.5, 0.5]]


def test_mcnemars_exact_test_by_hand() -> None:
    # One side fails all of five differing drives: 2 * (1/2)^5.
    assert paired_failures(5, 0) == pytest.approx(2 / 32)
    assert paired_failures(3, 3) == 1.0
    assert paired_failures(0, 0) == 1.0


# Plans of draws -----------------------------------------------------------------------------------


def drawn(cells: list[tuple[Any, Any, Any]]) -> list[list[int]]:
    """Drives of each stratum, units that are drawn as one in lists."""
    plan = plan_of(cells)
    return [np.flatnonzero(np.isin(plan.unit, units)).tolist() for units in plan.strata]


def test_seeds_are_drawn_for_all_their_paths_at_once() -> None:
    cells = [("realtime", path, seed) for path in ("T2", "T4") for seed in (0, 1, 2)]
    plan = plan_of(cells)
    assert plan.unit.tolist() == [0, 1, 2, 0, 1, 2]
    assert [units.tolist() for units in plan.strata] == [[0, 1, 2]]
    assert "3 seeds, stratified by path (2 paths" in plan.words
    assert "stratified by path (1 path; a seed" in plan_of(cells[:3]).words
    # A path with other seeds is a stratum of its own.
    plan = plan_of([*cells, ("realtime", "T5", 7), ("realtime", "T5", 8)])
    assert [units.tolist() for units in plan.strata] == [[0, 1, 2], [3, 4]]


def test_drives_that_are_alone_on_their_path_are_drawn_within_their_setting() -> None:
    cells = [("simulation", path, 0) for path in ("T2", "T4", "T5")]
    assert drawn(cells) == [[0, 1, 2]]
    assert "3 drives that are alone on their path" in plan_of(cells).words
    assert drawn([*cells, ("realtime", "T2", 0), ("realtime", "T2", 1)]) == [[0, 1, 2], [3, 4]]
    # Several starts on one path, all of one seed.
    assert drawn([("simulation", "T2", 0)] * 3) == [[0, 1, 2]]
    assert plan_of([("simulation", "T2", 0)] * 3).unit.tolist() == [0, 1, 2]
    # One drive in each of two settings, and one drive in all.
    assert drawn([("a", "T2", 0), ("b", "T2", 0)]) == [[0, 1]]
    alone = plan_of([("a", "T2", 0)])
    assert alone.strata == ()
    assert alone.words == ""


def mean_of(values: Array) -> Any:
    return lambda drives, *_: ((drives @ values) / drives.sum(axis=1))[None]


def test_one_drive_alone_has_no_interval() -> None:
    found = bootstrap_intervals(mean_of(np.array([3.0])), plan_of([("a", "T2", 0)]))
    assert found.value.tolist() == [3.0]
    assert np.isnan([found.low[0], found.high[0]]).all()
    assert found.resamples == 0


def test_trainings_and_drives_are_drawn_apart() -> None:
    """Trainings differ, drives do not: draws of drives alone have no spread."""
    plan = plan_of([("a", "T2", seed) for seed in range(4)])
    by_training, by_drive = np.array([1.0, 2.0, 3.0]), np.zeros(4)
    table = by_training[:, None] + by_drive

    def mean(drives: Array, trainings: Array) -> Array:
        runs = run_weights(drives, trainings)
        return ((runs @ table.ravel()) / runs.sum(axis=1))[None]

    drives_alone = bootstrap_intervals(mean, plan, (3,), draw_trainings=False)
    trainings_alone = bootstrap_intervals(mean, plan, (3,), draw_drives=False)
    assert drives_alone.low == drives_alone.high == 2.0
    assert trainings_alone.low == 1.0
    assert trainings_alone.high == 3.0


def test_many_drives_are_resampled_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resampling, "MOST_DRAWS", 160_000)
    values = np.random.default_rng(0).normal(size=100)
    plan = plan_of([("a", "T2", seed) for seed in range(100)])
    found = bootstrap_intervals(mean_of(values), plan)
    assert found.resamples == 1600
    monkeypatch.setattr(resampling, "MOST_DRAWS", 6)
    assert bootstrap_intervals(mean_of(values), plan).resamples == resampling.FEWEST


def test_intervals_of_few_drives_are_as_wide_as_those_of_students_t() -> None:
    """The two agree for the mean of normals, with ten drives or forty."""
    rng = np.random.default_rng(4)
    for number in (10, 40):
        values = rng.normal(size=number)
        found = bootstrap_intervals(
            mean_of(values), plan_of([("a", "T2", seed) for seed in range(number)])
        )
        exact = ttest_1samp(values, 0.0).confidence_interval()
        width = float(found.high[0] - found.low[0])
        assert width == pytest.approx(exact.high - exact.low, rel=0.08)


@pytest.mark.parametrize(("shared", "seeds"), [(0.0, 40), (1.0, 40), (1.0, 10)])
def test_intervals_cover_the_truth_as_often_as_they_say(
    shared: float, seeds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the drives of a seed have a disturbance in common on all paths."""
    monkeypatch.setattr(resampling, "RESAMPLES", 600)
    rng, studies, paths = np.random.default_rng(3), 300, 4
    cells = [("realtime", path, seed) for path in range(paths) for seed in range(seeds)]
    plan = plan_of(cells)
    tasks = np.repeat(np.arange(paths), seeds)
    held = np.zeros(3)
    for study in range(studies):
        common = shared * rng.normal(size=(1, seeds))
        ours = (common + rng.normal(size=(paths, seeds))).ravel()
        theirs = (common + rng.normal(size=(paths, seeds))).ravel() + 0.5

        def statistic(drives: Array, ours: Array = ours, theirs: Array = theirs) -> Array:
            return np.stack(
                [
                    drives @ (theirs - ours) / drives.sum(axis=1),
                    weighted_interquartile_mean(ours, drives),
                    probability_of_improvement(ours, theirs, tasks, tasks, drives, drives),
                ]
            )

        found = bootstrap_intervals(statistic, plan, seed=study)
        # P(X < Y) of normals 0.5 apart, each of variance 1 + shared^2, other seeds included.
        truth = 0.5, 0.0, norm.cdf(0.5 / np.sqrt(2.0 * (1.0 + shared**2)))
        held += (found.low <= truth) & (truth <= found.high)
    low, high = binom.ppf([1e-3, 1 - 1e-3], studies, [0.90, 0.97])
    assert (held >= low).all(), held
    assert (held <= high).all(), held
