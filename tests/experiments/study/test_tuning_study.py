"""Evaluation of weights against single cases of the benchmark, and a study that goes on."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("stable_baselines3")
pytest.importorskip("cma")

import agents
import trajectories
from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.policy import WeightPolicy, load
from agents.weight_tuning.score import FAILED, PARTS
from agents.weights import TrackingWeights, WeightSchedule
from experiments.cli import parser
from experiments.commands.tune import settings_of
from experiments.run.case import Case, run_case
from experiments.run.engines import Engine
from experiments.run.metrics import evaluate
from experiments.run.rollout import rollout
from experiments.run.store import write_arrays
from experiments.study import study
from experiments.study.evaluation import (
    FIGURES,
    IN_BANDS,
    EvaluationSet,
    Evaluator,
    band_scores,
    usual_sets,
)
from experiments.study.study import (
    BASELINE,
    OURS,
    RUNGS,
    Rung,
    Study,
    checked_labels,
    read_figures,
    run_evaluations,
    run_trainings,
    rung_of,
)
from experiments.tuning.settings import LEARNED, usual
from lpv_track_env import kernels
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.observation import ObservationLayout
from tests.helpers.weight_policies import random_weight_policy
from trajectories import CurvatureBands

Array = NDArray[Any]

# Sets that tell the bands apart; the sharpest is that of the whole figure eight by the path's rule.
SCHEDULE = WeightSchedule(
    CurvatureBands(),
    tuple(
        TrackingWeights(Q=(1.0, q, 3.0 * q, 3.0 * q), R=(0.05, 1.0)) for q in (0.3, 1.0, 2.0, 4.0)
    ),
    slew=6.0,
)
SETTINGS: dict[str, Any] = {"time_limit": 4.0}


def evaluated(result: Any, conditions: str, **more: Any) -> dict[str, Array]:
    given = EvaluationSet("few", ("figure-eight",), conditions, 2, env_settings=SETTINGS)
    figures = Evaluator(given).evaluate(result, **more)
    assert set(figures) == set(FIGURES)
    assert all(values.shape == (1, 2) for values in figures.values())
    return {name: values[0] for name, values in figures.items()}


def test_scores_in_bands_are_those_of_their_periods() -> None:
    """On a circle all periods are of one band; on a figure of eight squares add up over bands."""
    given = EvaluationSet("few", ("circle", "figure-eight"), "realtime", 2, env_settings=SETTINGS)
    figures = Evaluator(given).evaluate(SCHEDULE)
    assert not figures["failed"].any()
    np.testing.assert_allclose(figures["in_moderate"][0], figures["score"][0], rtol=1e-9)
    for band in ("straight", "gentle", "sharp"):
        assert np.isnan(figures[f"in_{band}"][0]).all()
    eight = np.array([figures[f"in_{band}"][1] for band in CurvatureBands().names])
    seen = np.isfinite(eight).sum(axis=0)
    assert (seen >= 2).all()
    # The score adds five root mean squares. By Minkowski's inequality it is at least the least of
    # the parts', and by Cauchy's at most sqrt(5) times the largest.
    assert (np.nanmin(eight, axis=0) <= figures["score"][1]).all()
    assert (np.sqrt(5.0) * np.nanmax(eight, axis=0) >= figures["score"][1]).all()


def test_a_band_s_score_is_of_its_periods_alone() -> None:
    """Made traces have lateral errors of two sizes, each in a band of its own."""
    path = trajectories.load("figure-eight")
    places = np.linspace(0.0, path.length, 400, endpoint=False)
    bands = CurvatureBands().classify(path.sample(places).curvature)
    trace = np.zeros((1, 401, kernels.RECORD_SIZE))
    trace[0, 1:, kernels.ARC_LENGTH] = places
    trace[0, 1:, kernels.LATERAL_ERROR] = 0.05 * (1.0 + bands)
    trace[0, 300:] = np.nan
    found = band_scores(trace, path, PathTrackingEnv(path))
    for index, name in enumerate(CurvatureBands().names):
        if (bands[:299] == index).any():
            assert found[f"in_{name}"][0] == pytest.approx(1.0 + index, rel=1e-12)
        else:
            assert np.isnan(found[f"in_{name}"][0])


def check_against_case(figures: dict[str, Array], seed: int, case: dict[str, Any]) -> None:
    """Figures of a drive are those of a case's metrics, or of its trace where a rule differs."""
    metrics, trace = case["metrics"], case["trace"]
    found = {name: float(values[seed]) for name, values in figures.items()}
    steps = len(trace["time"]) - 1
    # The same to rounding, though one sums in compiled code.
    assert found["steering_rate"] * 0.2 == pytest.approx(metrics["steering_rate_rms"], rel=1e-9)
    assert found["jerk"] * 4.0 == pytest.approx(metrics["jerk_rms"], rel=1e-9)
    assert found["clipped"] == pytest.approx(metrics["clipped_share"], rel=1e-12)
    # The largest of where it drove: that of where it began is nobody's doing.
    lateral, heading = trace["lateral_error"][1:], trace["heading_error"][1:]
    assert found["max_cte"] == pytest.approx(np.abs(lateral).max(), rel=1e-9)
    assert found["max_cte"] <= metrics["max_cte"] + 1e-9
    # A mean of squares over periods, at their ends; the metrics' are by the trapezoidal rule.
    assert found["ale"] == pytest.approx(math.sqrt(np.mean(lateral**2)), rel=1e-9)
    assert found["aoe"] == pytest.approx(math.sqrt(np.mean(heading**2)), rel=1e-9)
    ends = 0.5 * (trace["lateral_error"][0] ** 2 - trace["lateral_error"][-1] ** 2)
    assert metrics["ale"] == pytest.approx(math.sqrt(found["ale"] ** 2 + ends / steps), rel=1e-9)
    np.testing.assert_allclose(
        [found["lateral"] * 0.05, found["heading"] * 0.1], [found["ale"], found["aoe"]], rtol=1e-12
    )
    assert found["score"] == pytest.approx(sum(found[name] for name in PARTS), rel=1e-12)
    limits = ("lateral_velocity", "steering_rate", "jerk")
    shares = [metrics[f"violated_{name}"] for name in limits]
    assert max(shares) - 1e-12 <= found["violated"] <= sum(shares) + 1e-12
    assert found["failed"] == (case["end"] not in {"finished", "time_limit"})


@pytest.mark.parametrize("conditions", ["simulation", "realtime", "randomised"])
def test_an_evaluated_schedule_drives_as_the_benchmarks_agent(
    conditions: str, tmp_path: Path
) -> None:
    figures = evaluated(SCHEDULE, conditions)
    SCHEDULE.write(tmp_path / "weights.json")
    settings = {"weights": str(tmp_path / "weights.json")}
    for seed in (0, 1):
        case = run_case({
            "agent": "lpv-nmpc-tuned", "trajectory": "figure-eight", "conditions": conditions,
            "seed": seed, "env_settings": SETTINGS, "agent_settings": settings,
        })  # fmt: skip
        assert case["status"] == "ok", case
        check_against_case(figures, seed, case)
        assert figures["failures"][seed] == case["solver"]["failures"]


def driven(agent: str, seed: int, conditions: str, **settings: Any) -> dict[str, Any]:
    """Drive as `run_case` does, for settings that no file holds."""
    case = Case(agent, "figure-eight", conditions=conditions, seed=seed, env_settings=SETTINGS)
    env = case.make_env()
    found = rollout(env, agents.make(agent, env, **settings), seed=seed)
    metrics = evaluate(found.trace, found.path, case.make_vehicle())
    return {"metrics": metrics, "trace": found.trace.as_dict(), "end": found.end}


def test_evaluated_by_path_it_drives_with_the_path_s_set() -> None:
    figures = evaluated(SCHEDULE, "realtime", by_path=True)
    check_against_case(
        figures, 0, driven("lpv-nmpc", 0, "realtime", weights=SCHEDULE, selection="path")
    )
    sharpest = WeightSchedule(SCHEDULE.bands, (SCHEDULE.weights[-1],) * 4)
    for name, values in evaluated(sharpest, "realtime").items():
        np.testing.assert_array_equal(figures[name], values, err_msg=name)
    assert (figures["score"] != evaluated(SCHEDULE, "realtime")["score"]).all()


def test_an_evaluated_policy_drives_as_the_benchmarks_agent() -> None:
    choice = WeightChoice(SCHEDULE, span=3.0)
    policy: WeightPolicy = random_weight_policy(1, choice=choice, layout=ObservationLayout())
    figures = evaluated(policy, "realtime")
    for seed in (0, 1):
        check_against_case(
            figures, seed, driven("lpv-nmpc-tuned", seed, "realtime", weights=policy)
        )


def test_a_drive_that_fails_scores_as_one() -> None:
    narrow = {"time_limit": 4.0, "max_lateral_error": 0.01}
    given = EvaluationSet("narrow", ("circle", "figure-eight"), seeds=2, env_settings=narrow)
    figures = Evaluator(given).evaluate(SCHEDULE)
    np.testing.assert_array_equal(figures["failed"], 1.0)
    np.testing.assert_array_equal(figures["score"], FAILED)
    assert (figures["max_cte"] > 0.01).all()


def test_evaluation_sets_are_of_paths_that_tuning_refuses() -> None:
    for given in usual_sets(3):
        assert given.seeds in {1, 2, 3}
        assert given.labels == given.trajectories
        for name in given.labels:
            with pytest.raises(ValueError, match="evaluation"):
                usual("search", trajectories=(name,))


# Rungs and the study ----------------------------------------------------------------------------


def test_rungs_differ_in_what_they_say() -> None:
    assert len({one.label for one in RUNGS}) == len(RUNGS)
    for one in RUNGS:
        settings = one.settings(3, 1000)
        assert (settings.method, settings.seed) == (one.method, 3)
        assert (settings.view, settings.conditions) == (one.view, one.conditions)
        assert settings.solves == 1000 * one.factor
        assert rung_of(one.baseline).conditions == one.conditions
        assert rung_of(one.label) is one
    assert {one.factor for one in RUNGS if BASELINE in one.label} == {10}
    assert rung_of(OURS).method in LEARNED
    assert checked_labels(["rl", "default"]) == ("rl", "default")
    with pytest.raises(ValueError, match="gradient"):
        checked_labels(["gradent"])


class ShortRung(Rung):
    """A rung on short drives of two paths."""

    def settings(self, seed: int, solves: int) -> Any:
        return usual(
            self.method, seed=seed, solves=self.factor * solves, trajectories=("circle", "sine"),
            drives=1, time_limit=0.5, conditions="simulation",
            hyperparameters={"rollout": 4, "batch": 4, "hidden": [8], "segment": 64}
            if self.method in LEARNED else {},
        )  # fmt: skip


LABELS = ("default", "search", "rl")


@pytest.fixture(name="short")
def fixture_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    """A study of three rungs and two seeds, in this process."""
    short = {
        label: ShortRung(label, rung_of(label).method, "short", 1 + (label == "rl"))
        for label in LABELS
    }
    monkeypatch.setattr(study, "rung_of", short.__getitem__)
    few = EvaluationSet(
        "few, short", ("circle", "sine"), "simulation", 2, env_settings={"time_limit": 1.0}
    )
    return Study(tmp_path, LABELS, (0, 1), 100, (few,))


def times(folder: Path) -> dict[str, int]:
    files = [*folder.glob("trainings/*/weights.json"), *folder.glob("judged/*/*.npz")]
    return {str(file.relative_to(folder)): file.stat().st_mtime_ns for file in files}


def test_a_study_is_made_read_and_not_made_again(short: Study) -> None:
    assert [(one.label, seed) for one, seed in short.trainings()] == [
        ("rl", 0), ("rl", 1), ("default", 0), ("search", 0), ("search", 1),
    ]  # fmt: skip
    assert list(run_trainings(short, Engine(1))) == [(k, 5) for k in range(6)]
    assert list(run_evaluations(short, Engine(1))) == [(0, 1), (1, 1)]
    made = times(short.folder)
    assert len(made) == 10
    assert list(run_trainings(short, Engine(1))) == [(0, 0)]
    assert list(run_evaluations(short, Engine(1))) == [(0, 0)]
    assert times(short.folder) == made

    for label in LABELS:
        seeds = 1 if label == "default" else 2
        figures = short.read("few, short", label)
        assert {values.shape for values in figures.values()} == {(seeds, 2, 2)}
        # But in bands that a path does not have.
        finite = [name for name, values in figures.items() if np.isfinite(values).all()]
        assert set(FIGURES) - set(finite) <= set(IN_BANDS)
        for seed in range(seeds):
            lines = short.progress(label, seed)
            assert bool(lines) == (label != "default")
            assert all(line["solves"] <= 100 * (1 + (label == "rl")) for line in lines)
    weights = load(short.training("search", 1) / "weights.json")
    again = Evaluator(short.sets[0]).evaluate(weights)
    for name, values in short.read("few, short", "search").items():
        np.testing.assert_array_equal(values[1], again[name])

    # What is missing is made again, nothing else, and comes out the same.
    lost = short.training("search", 0) / "weights.json"
    score = short.read("few, short", "search")["score"]
    lost.unlink()
    short.evaluation("few, short", "search", 0).unlink()
    assert list(run_trainings(short, Engine(1))) == [(0, 1), (1, 1)]
    assert list(run_evaluations(short, Engine(1))) == [(0, 1), (1, 1)]
    now = times(short.folder)
    assert {name for name in made if now[name] != made[name]} == {
        "trainings/search-0/weights.json", "judged/few-short/search-0.npz",
    }  # fmt: skip
    np.testing.assert_array_equal(short.read("few, short", "search")["score"], score)


@pytest.mark.parametrize("one", RUNGS, ids=lambda one: one.label)
def test_the_command_of_a_rung_asks_for_its_settings(one: Rung) -> None:
    options = parser().parse_args(one.command(3, 5000).split()[1:])
    assert settings_of(options) == one.settings(3, 5000)


def test_damaged_figures_are_one_line(tmp_path: Path) -> None:
    file = tmp_path / "judged" / "figures.npz"
    rng = np.random.default_rng(0)
    figures = {name: rng.normal(size=(3, 4)) for name in FIGURES}
    write_arrays(file, figures)
    for name, values in read_figures(file).items():
        np.testing.assert_array_equal(values, figures[name])
    good = file.read_bytes()
    middle = bytearray(good)
    middle[150:190] = bytes(40)
    np.savez(tmp_path / "other.npz", score=figures["score"])
    pickled = np.array([{}], dtype=object)
    np.savez(tmp_path / "pickled.npz", **dict.fromkeys(FIGURES, pickled))
    for content in (
        b"", b"PK", good[:-1], good[: len(good) // 2], bytes(300), bytes(middle),
        (tmp_path / "other.npz").read_bytes(), (tmp_path / "pickled.npz").read_bytes(),
    ):  # fmt: skip
        file.write_bytes(content)
        with pytest.raises(ValueError, match="remove it, and it is made anew") as caught:
            read_figures(file)
        assert str(file) in str(caught.value)
        assert "\n" not in str(caught.value)
    file.unlink()
    with pytest.raises(ValueError, match="cannot be used"):
        read_figures(file)
