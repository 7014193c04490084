"""`lpv-track tune`: every method writes weights that load, within its budget, and finds optima."""

import importlib.util
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_tunings import SMALL, Counted, again, bits, progress, provenance, refusal, tuned, words

pytest.importorskip("stable_baselines3")
pytest.importorskip("cma")

import trajectories
from agents.weight_tuning.choice import SLEW
from agents.weight_tuning.files import load
from agents.weight_tuning.policy import WeightPolicy
from agents.weights import TrackingWeights, WeightSchedule
from experiments import cli
from experiments.results import revision, versions
from experiments.tuning import options
from experiments.tuning.by_path import PathClassSearch
from experiments.tuning.drives import TuningDrives, load_paths, path_names, weights_at
from experiments.tuning.gradient import GradientSearch
from experiments.tuning.search import CmaSearch, Search
from experiments.tuning.settings import (
    HYPERPARAMETERS,
    LEARNED,
    METHODS,
    TuningSettings,
    usual,
)

Array = NDArray[Any]
CIRCLE: dict[str, Any] = {
    "trajectories": ("circle",), "conditions": "simulation", "drives": 1, "time_limit": 0.5,
}  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_each_method_writes_weights_that_its_own_command_makes_again(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    weights = tuned(method, tmp_path / "one")
    spent = counted.solves
    result = load(weights)
    assert isinstance(result, WeightPolicy if method in LEARNED else WeightSchedule)
    told = provenance(result)
    settings = json.loads((tmp_path / "one" / "settings.json").read_text())
    assert told["settings"] == settings
    assert told["solves"] == spent <= settings["solves"]
    assert told["versions"] == versions()
    assert told["revision"] == revision()
    assert told["vehicle"] == "m2-minibus"
    assert told["hardware"]
    assert "--out" not in told["command"]
    assert bits(again(weights, tmp_path / "two")) == bits(weights)
    if method == "fixed":
        assert spent == 0
        assert set(result.weights) == {TrackingWeights()}  # type: ignore[union-attr]
        return
    lines = progress(weights)
    assert [line["step"] for line in lines] == list(range(len(lines)))
    assert len(lines) == 3
    assert lines[-1]["solves"] == spent
    other = load(tuned(method, tmp_path / "three", "--seed", "1"))
    if isinstance(result, WeightPolicy):
        assert isinstance(other, WeightPolicy)
        assert (result.layers[0][0] != other.layers[0][0]).any()
        assert result.algorithm == method
        assert len(result.choice.catalogue) == (25 if method == "catalogue" else 0)
    else:
        assert isinstance(other, WeightSchedule)
        assert result.weights != other.weights
        assert result.slew == SLEW
        # One set for all, or one for each.
        assert len(set(result.weights)) == {"search": 1, "paper": 3}.get(method, 4)


@pytest.mark.parametrize("method", SMALL)
def test_a_budget_that_allows_no_step_is_refused(
    method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    counted, cost = Counted(monkeypatch), SMALL[method][1]
    own = cost // 3 if method == "paper" else cost  # enough for one class of path
    short = words(method, "--solves", str(own - 1), "--out", str(tmp_path / "short"))
    error = refusal(capsys, *short)
    assert "--solves" in error
    assert f"takes {own:,} solves" in error
    assert counted.solves == 0
    # It is the least: with one more there is a step.
    tuned(method, tmp_path / "out", "--solves", str(own))
    assert 0 < counted.solves <= own


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--trajectories", "circle", "T1"], "T1 is for evaluation"),
        (["--trajectories", "T6-raw"], "evaluation"),
        (["--trajectories", "random-0"], "evaluation"),
        (["--trajectories", "random-fast-19"], "evaluation"),
        (["--trajectories", "circel"], "circle"),
        (["--solves", "0.5"], "whole number"),
        (["--solves", "inf"], "whole number"),
        (["--seed", "1000"], "seed"),
        (["--drives", "0"], "drives"),
        (["--random-paths", "1001"], "1000"),
        (["--span", "1"], "span must be above 1"),
        (["--span", "0"], "span must be above 1"),
        (["--span", "nan"], "span must be above 1"),
        (["--window", "0"], "window must be positive"),
        (["--window", "nan"], "window must be positive"),
        (["--time-limit", "0.1"], "at least the window"),
        (["--time-limit", "inf"], "finite"),
        (["--control-period", "0"], "control_period"),
        (["--directions", "al"], "all"),
        (["--view", "driver"], "drive"),
        (["--vehicle", "m2"], "m2-minibus"),
        (["--conditions", "realtme"], "realtime"),
        (["--conditions-set", "gnss_nois=1"], "gnss_noise"),
        (["--set", "pairs=2"], "sigma"),
        (["--set", "sigma=0"], "must be like"),
        (["--set", "sigma=wide"], "must be like"),
        (["--method", "rl", "--set", "batch=1"], "batch must be in"),
        (["--method", "rl", "--set", "discount=1.5"], "discount must be in"),
        (["--method", "rl", "--set", "hidden=[0]"], "must be like"),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    given: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["tune", "--method", "search", "--trajectories", "circle", "--drives", "1"]
    error = refusal(capsys, *common, *given, "--out", str(tmp_path / "out"))
    assert said in error
    assert not list(tmp_path.glob("out/weights*"))


def test_no_two_seeds_tune_on_the_same_paths() -> None:
    names = [set(path_names(usual("search", seed=seed, paths=1000))) for seed in (0, 1, 999)]
    assert len(set.union(*names)) == 3000
    assert min(int(name.rpartition("-")[2]) for name in names[0]) >= 10_000_000


def test_candidates_of_a_round_meet_the_same_drives_and_another_round_others() -> None:
    settings = usual("search", trajectories=("sine",), drives=3, time_limit=1.0, window=0.4)
    drives = TuningDrives(settings, load_paths(settings))
    default = TrackingWeights().as_array()
    first = drives.scores(default, 0)
    softer = drives.scores(np.concatenate([0.1 * default[:8], default[8:]]), 0)
    other = drives.scores(default, 1)
    np.testing.assert_array_equal(drives.scores(default, 0), first)
    assert (softer != first).all()
    assert not set(first) & set(other)
    assert drives.solves <= 4 * drives.most == 4 * 3 * 20


def test_log_multipliers_are_bounded_by_the_span_and_leave_r() -> None:
    settings = usual("search", span=100.0)
    default = TrackingWeights().as_array()
    moved = weights_at(np.array([[0.0] * 6, [math.log(2.0), 0, 0, 0, 0, 99.0]]), settings)
    np.testing.assert_array_equal(moved[0], default)
    factors = [2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 100.0, 100.0, 1.0, 1.0]
    np.testing.assert_allclose(moved[1], default * factors, rtol=1e-14)


# Searches, judged by functions -----------------------------------------------------------------


def judged_by(
    monkeypatch: pytest.MonkeyPatch, kind: type[Search], score: Callable[[Array], float]
) -> None:
    monkeypatch.setattr(kind, "judge", lambda _, points, __: [score(point) for point in points])


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
    judged_by(monkeypatch, CmaSearch, lambda x: float(steepness @ (x - best) ** 2))
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
    judged_by(monkeypatch, CmaSearch, lambda x: float(np.sum((x - 9.0) ** 2)))
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
    search = GradientSearch(settings, load_paths(settings), 1)
    scores = np.array(search.judge([np.zeros(6)] * 6, 0)).reshape(3, 2)
    np.testing.assert_array_equal(scores[:, 0], scores[:, 1])
    assert len(set(scores[:, 0])) == 3
    points = search.ask()
    np.testing.assert_allclose(points[0], -points[1])


def test_gradients_descend(monkeypatch: pytest.MonkeyPatch) -> None:
    best = np.random.default_rng(0).uniform(-2.0, 2.0, 24)
    judged_by(monkeypatch, GradientSearch, lambda x: float(0.5 * np.sum((x - best) ** 2)))
    search = searching("gradient", 4, hyperparameters={"learning_rate": 0.1})
    for _ in range(300):
        search.step()
    # The start is 5.6 away; the steps, of constant size, keep it in motion.
    assert np.linalg.norm(search.point.ravel() - best) < 0.5
    assert np.linalg.norm(best) > 5.0


# A set for each class of path -------------------------------------------------------------------


def by_class(solves: int, *names: str) -> PathClassSearch:
    settings = usual("paper", **{**CIRCLE, "trajectories": names, "solves": solves})
    return PathClassSearch(settings, load_paths(settings))


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


def test_the_help_names_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["tune", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert options.METHODS == tuple(METHODS) == tuple(HYPERPARAMETERS)
    for method, defaults in HYPERPARAMETERS.items():
        for name in (method, *defaults):
            assert name in said
    fields = set(TuningSettings.__dataclass_fields__) - {"hyperparameters", "paths"}
    for name in fields:
        assert f"--{name.replace('_', '-')}" in said


@pytest.mark.parametrize(
    ("method", "lacking", "extra"),
    [("search", "cma", "tune"), ("rl", "stable_baselines3", "rl")],
)
def test_without_the_extra_it_says_what_to_install(
    method: str, lacking: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    found = importlib.util.find_spec
    missing = "experiments.tuning.command.find_spec"
    monkeypatch.setattr(missing, lambda name: None if name == lacking else found(name))
    error = refusal(capsys, *words(method, "--out", str(tmp_path)))
    assert f"needs {lacking}: pip install 'lpv-track-env[{extra}]'" in error
