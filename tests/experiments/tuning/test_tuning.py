"""`lpv-track tune`: every method writes weights that load, within its budget, and finds optima."""

import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.small_tunings import (
    SMALL,
    Counted,
    again,
    bits,
    progress,
    provenance,
    refusal,
    tuned,
    words,
)

pytest.importorskip("stable_baselines3")
pytest.importorskip("cma")

from agents.weight_tuning.choice import SLEW
from agents.weight_tuning.policy import WeightPolicy, load
from agents.weights import TrackingWeights, WeightSchedule
from experiments import cli
from experiments.jobs.job import load_paths
from experiments.run.provenance import revision, versions
from experiments.tuning import METHODS
from experiments.tuning.loop import path_names
from experiments.tuning.settings import HYPERPARAMETERS, LEARNED, TuningSettings, usual
from experiments.tuning.tuner import TuningDrives, weights_at


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
        (["--random-paths", "1001"], "--random-paths must be a whole number from 1 to 1,000"),
        (["--span", "1"], "--span must be in (1, 10000]"),
        (["--span", "0"], "--span must be in (1, 10000]"),
        (["--span", "nan"], "--span must be in (1, 10000]"),
        (["--window", "0"], "--window must be positive"),
        (["--window", "nan"], "--window must be positive"),
        (["--time-limit", "0.1"], "at least the window"),
        (["--time-limit", "inf"], "--time-limit must be positive and at most 1e+06 s"),
        (["--control-period", "0"], "--control-period must be in [0.001, 1] s"),
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
    drives = TuningDrives(settings, load_paths(path_names(settings)))
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
    moved = weights_at(
        np.array([[0.0] * 6, [math.log(2.0), 0, 0, 0, 0, 99.0]]), settings.directions, settings.span
    )
    np.testing.assert_array_equal(moved[0], default)
    factors = [2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 100.0, 100.0, 1.0, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(moved[1], default * factors, rtol=1e-14)


def test_the_help_names_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["tune", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert tuple(HYPERPARAMETERS) == METHODS
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
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == lacking else found(name)
    )
    error = refusal(capsys, *words(method, "--out", str(tmp_path)))
    assert f"needs {lacking}: pip install 'lpv-track-env[{extra}]'" in error
