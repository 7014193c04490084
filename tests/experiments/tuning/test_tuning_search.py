"""Searches of `lpv-track tune` find optima; a class of path has its share of the budget."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("cma")

import trajectories
from agents.weights import TrackingWeights
from experiments.jobs.job import load_paths
from experiments.tuning.loop import path_names
from experiments.tuning.search import CmaSearch, GradientSearch, PathClassSearch, Search
from experiments.tuning.settings import HYPERPARAMETERS, usual

Array = NDArray[Any]
CIRCLE: dict[str, Any] = {
    "trajectories": ("circle",), "conditions": "simulation", "drives": 1, "time_limit": 0.5,
}  # fmt: skip


def scored_by(
    monkeypatch: pytest.MonkeyPatch, kind: type[Search], score: Callable[[Array], float]
) -> None:
    monkeypatch.setattr(kind, "evaluate", lambda _, points, __: [score(point) for point in points])


def searching(method: str, rows: int, **changes: Any) -> Search:
    settings = usual(method, **{**CIRCLE, **changes})
    kind = GradientSearch if method == "gradient" else CmaSearch
    return kind(settings, [trajectories.load("circle")], rows)


@pytest.mark.parametrize("rows", [1, 4])
def test_cma_es_finds_the_optimum_of_a_quadratic(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = np.random.default_rng(0).uniform(-2.0, 2.0, rows * 6)
    steepness = 10.0 ** np.linspace(0.0, 1.0, best.size)
    scored_by(monkeypatch, CmaSearch, lambda x: float(steepness @ (x - best) ** 2))
    search = searching("search", rows)
    np.testing.assert_array_equal(search.point, np.zeros((rows, 6)))
    for _ in range(120 if rows == 1 else 500):
        search.step()
    np.testing.assert_allclose(search.point.ravel(), best, atol=1e-4)
    sets = search.result({}).weights
    expected = TrackingWeights().as_array()
    expected[:8] *= np.exp(best.reshape(rows, 6)[-1][[0, 1, 2, 2, 3, 4, 5, 5]])
    np.testing.assert_allclose(sets[-1].as_array(), expected, rtol=1e-3)


def test_cma_es_stays_within_the_span(monkeypatch: pytest.MonkeyPatch) -> None:
    scored_by(monkeypatch, CmaSearch, lambda x: float(np.sum((x - 9.0) ** 2)))
    search = searching("search", 1, span=10.0)
    for _ in range(60):
        search.step()
    np.testing.assert_allclose(search.point, math.log(10.0), atol=1e-3)


def test_gradients_are_those_of_the_smoothed_score() -> None:
    search = searching("gradient", 1, hyperparameters={"pairs": 64})
    slope = np.array([0.3, -0.2, 0.1, 0.0, 0.25, -0.05])
    phase = np.linspace(-1.0, 1.0, 6)
    estimates = np.array(
        [
            search.gradient([float(slope @ np.sin(point + phase)) for point in search.ask()])  # type: ignore[attr-defined]
            for _ in range(2000)
        ]
    )
    # Of sin smoothed by a Gaussian of standard deviation s: cos times exp(-s^2 / 2).
    smoothed = slope * np.cos(phase) * math.exp(-0.5 * HYPERPARAMETERS["gradient"]["sigma"] ** 2)
    error = estimates.std(axis=0, ddof=1) / math.sqrt(len(estimates))
    assert (np.abs(estimates.mean(axis=0) - smoothed) < 4.0 * error).all()
    # Sharp enough to tell the smoothed from the bare one.
    assert np.abs(slope * np.cos(phase) - smoothed).max() > 8.0 * error.max()


def test_a_pair_differs_in_its_weights_only() -> None:
    settings = usual("gradient", trajectories=("sine",), time_limit=1.0,
                     hyperparameters={"pairs": 3})  # fmt: skip
    search = GradientSearch(settings, load_paths(path_names(settings)), 1)
    scores = np.array(search.evaluate([np.zeros(6)] * 6, 0)).reshape(3, 2)
    np.testing.assert_array_equal(scores[:, 0], scores[:, 1])
    assert len(set(scores[:, 0])) == 3
    points = search.ask()
    np.testing.assert_allclose(points[0], -points[1])


def test_gradients_descend(monkeypatch: pytest.MonkeyPatch) -> None:
    best = np.random.default_rng(0).uniform(-2.0, 2.0, 24)
    scored_by(monkeypatch, GradientSearch, lambda x: float(0.5 * np.sum((x - best) ** 2)))
    search = searching("gradient", 4, hyperparameters={"learning_rate": 0.1})
    for _ in range(300):
        search.step()
    # The start is 5.6 away; the steps, of constant size, keep it in motion.
    assert np.linalg.norm(search.point.ravel() - best) < 0.5
    assert np.linalg.norm(best) > 5.0


# A set for each class of path -------------------------------------------------------------------


def by_class(solves: int, *names: str) -> PathClassSearch:
    settings = usual("paper", **{**CIRCLE, "trajectories": names, "solves": solves})
    return PathClassSearch(settings, load_paths(path_names(settings)))


def test_each_class_of_path_has_its_share_of_the_budget() -> None:
    # Straight; moderate, by a radius of 30 m; two of random paths' sharp turns.
    search = by_class(720, "straight", "circle", "random-20", "random-22")
    assert {band: one.settings.solves for band, one in search.searches.items()} == {
        0: 180, 2: 180, 3: 360,
    }  # fmt: skip
    while not search.done:
        search.step()
    assert {band: one.solves for band, one in search.searches.items()} == {0: 180, 2: 180, 3: 360}
    assert search.solves == 720
    sets = search.result({}).weights
    # None is gentle: it takes a neighbour's.
    assert sets[1] in {sets[0], sets[2]}
    assert len(set(sets)) == 3
    for band, one in search.searches.items():
        assert sets[band] == one.result({}).weights[0]


def test_a_class_whose_share_allows_no_generation_takes_its_neighbours_set() -> None:
    # A quarter of 350 is less than a generation, 90.
    search = by_class(350, "circle", "random-20", "random-22", "random-24")
    assert list(search.searches) == [3]
    assert search.searches[3].settings.solves == 350
    search.step()
    sets = search.result({}).weights
    assert set(sets) == {sets[3]} != {TrackingWeights()}
