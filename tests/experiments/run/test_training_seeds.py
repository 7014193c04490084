"""Several trainings of one agent: folders as agents, and both spreads in tables and ranking."""

import html
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata

from agents.weights import TrackingWeights, WeightSchedule
from experiments import cli
from experiments.run import regimes, tables
from experiments.run.console_tables import over_seeds
from experiments.run.ranking import ranking
from experiments.run.store import ResultStore
from experiments.run.training_folders import expanded
from tests.helpers.made_results import case as made
from tests.helpers.made_results import folder_of, page, printed
from trajectories import CurvatureBands


@pytest.mark.parametrize(
    ("agent", "settings", "label", "training"),
    [
        ("stanley", None, "stanley", None),
        ("results/ppo/seed-3/policy.json", {}, "results/ppo", 3),
        ("results/ppo/seed-999/policy.json", {"gain": 2}, "results/ppo (gain=2)", 999),
        ("seed-0/policy.json", {}, ".", 0),
        ("C:\\ppo\\seed-3\\policy.json", {}, "C:\\ppo", 3),
        ("lpv-nmpc-tuned", {"weights": "a/b/seed-12/weights.json"}, "a/b", 12),
        ("lpv-nmpc-tuned", {"weights": "b/seed-1/weights.json", "k": 1}, "b (k=1)", 1),
        ("lpv-nmpc", {"weights": "b/seed-1/weights.json"}, "lpv-nmpc (weights=b)", 1),
        ("lpv-nmpc-tuned", {"weights": "paired"}, "lpv-nmpc-tuned (weights=paired)", None),
        ("lpv-nmpc", {"weights": {"Q": [1]}}, "lpv-nmpc (weights={Q=[1]})", None),
        # Not as `train --seeds` names folders.
        ("ppo/seed-03/policy.json", {}, "ppo/seed-03/policy.json", None),
        ("ppo/seed-1000/policy.json", {}, "ppo/seed-1000/policy.json", None),
        ("ppo/seed-1/other.json", {}, "ppo/seed-1/other.json", None),
        ("ppo-seed-1/policy.json", {}, "ppo-seed-1/policy.json", None),
    ],
)
def test_trainings_in_folders_beside_each_other_are_one_agent(agent, settings, label, training):
    case = {"agent": agent, "agent_settings": settings}
    assert tables.label_of(case) == label
    assert tables.training_of(case) == training


def trained(number, training, seed, ale, folder="r/ppo", trajectory="T2", **more):
    """Result of one training of an agent, by evaluation seed."""
    return made(
        number, agent=f"{folder}/seed-{training}/policy.json", seed=seed, trajectory=trajectory,
        metrics={"ale": ale, "mle": ale}, **more,
    )  # fmt: skip


# ALE (m) of three trainings (rows) in two evaluation seeds.
ALE = np.array([[0.10, 0.14], [0.11, 0.13], [0.15, 0.15]])
T_975_1, T_975_2 = 12.706204736, 4.302652730


def several(ale=ALE, **more):
    return [
        trained(10 * k + seed, k, seed, value, **more)
        for k, row in enumerate(ale)
        for seed, value in enumerate(row)
    ]


def test_intervals_over_evaluation_seeds_and_over_trainings_stand_apart():
    """By hand: the means of the seeds are 0.12 and 0.14; of the trainings 0.12, 0.12 and 0.15."""
    row = tables.build_rows([*several(), made(99)])[1:]
    alone, ours = row
    assert (ours.name, ours.trainings, ours.runs) == ("r/ppo, 3 trainings", 3, 6)
    found = ours.values["ale"]
    assert found.mean == pytest.approx(0.13)
    assert found.half_width == pytest.approx(T_975_1 * 0.01 * 2**0.5 / 2**0.5)
    assert found.over_trainings == pytest.approx(
        T_975_2 * np.std([0.12, 0.12, 0.15], ddof=1) / 3**0.5
    )
    assert found.words(3) == "0.130 ±0.127 ±0.043"
    assert (alone.label, alone.trainings) == ("stanley", 0)
    assert alone.values["ale"].over_trainings is None
    assert over_seeds(several(), "ale") == found


def test_one_evaluation_seed_leaves_the_first_interval_out_in_words():
    found = over_seeds(several(ALE[:, :1]), "ale")
    assert found.half_width is None
    assert found.words(2) == "0.12 ±– ±0.07"


def test_a_single_training_has_no_interval_over_trainings():
    row = tables.build_rows(several(ALE[:1]))[1]
    assert row.name == "r/ppo"
    assert row.values["ale"].words(2) == "0.12 ±0.25"
    assert not tables.has_trainings(several(ALE[:1]))


def test_terminal_and_report_say_which_interval_is_which(tmp_path):
    text = " ".join(printed([*several(), made(99)]).split())
    assert "± over evaluation seeds ± over trainings" in text
    assert "0.130 0.130 stanley" not in text
    assert tables.TRAININGS_NOTE in text
    assert tables.SPREADS not in printed([made(1), made(2, seed=1)])
    words = page(folder_of(tmp_path, [*several(), made(99)], traces=False).folder)
    assert "r/ppo, 3 trainings" in words
    assert "0.130 ±0.127 ±0.043" in words
    assert tables.TRAININGS_NOTE in html.unescape(words)


def test_regimes_count_the_drives_of_all_trainings_and_show_the_range_of_their_failures():
    cases = several(regime="a")
    cases[0] = {**cases[0], "end": "left_corridor"}
    (line,) = regimes.lines(cases)
    name, drives, failed, interval, mle, *_ = line.cells
    assert (name, drives, failed) == ("r/ppo, 3 trainings", "6", "1")
    assert interval.endswith(", 0–50 % by training")
    # Means of the drives that finished: 0.14; 0.12; 0.15.
    spread = T_975_2 * np.std([0.14, 0.12, 0.15], ddof=1) / 3**0.5
    assert mle == f"0.136 ±{spread:.3f}"


def test_ranks_are_means_over_all_combinations_of_trainings():
    """Against ranks of every combination; the interval accounts for the trainings drawn."""
    rng = np.random.default_rng(1)
    one, two = rng.uniform(0.1, 0.2, (3, 4)), rng.uniform(0.1, 0.2, (2, 4))
    fixed = rng.uniform(0.1, 0.2, 4)
    cases = [
        *several(one, regime="a"),
        *several(two, folder="r/sac", regime="a"),
        *(made(90 + k, seed=k, regime="a", metrics={"mle": v}) for k, v in enumerate(fixed)),
    ]
    ranks = [rankdata([a, b, fixed], axis=0).mean(axis=1) for a, b in itertools.product(one, two)]
    expected = dict(zip(["r/ppo", "r/sac", "stanley"], np.mean(ranks, axis=0), strict=True))
    places = {place.label: place for place in ranking(cases)}
    assert {name: place.rank for name, place in places.items()} == pytest.approx(expected)
    assert (places["r/ppo"].drives, places["r/ppo"].trainings) == (12, 3)
    assert places["r/ppo"].cells[0] == "r/ppo, 3 trainings"
    assert places["r/ppo"].cells[-1].endswith("0–0 % by training")


def test_the_interval_of_a_rank_holds_trainings_that_differ():
    """Two trainings, always first and always last: their resamples give 1, 2 and 3."""
    ale = np.array([[0.1] * 8, [0.3] * 8])
    others = [
        made(1000 * k + seed, agent=name, seed=seed, regime="a", metrics={"mle": 0.2 + 0.01 * k})
        for k, name in enumerate(("stanley", "pid"), start=1)
        for seed in range(8)
    ]
    place = {one.label: one for one in ranking([*several(ale, regime="a"), *others])}["r/ppo"]
    assert (place.rank, place.low, place.high) == (2.0, 1.0, 3.0)
    # Alike in every drive, so that a bootstrap over drives alone would have no width.
    alone = {one.label: one for one in ranking([*several(ale[:1], regime="a"), *others])}["r/ppo"]
    assert (alone.rank, alone.low, alone.high) == (1.0, 1.0, 1.0)


def test_what_learning_cost_is_named_for_each_training_and_averaged_in_rows():
    costs = [{"algorithm": "ppo", "steps": 1000 * (k + 1), "seed": k} for k in range(3)]
    cases = [{**case, "training": costs[tables.training_of(case)]} for case in several()]
    assert [name for name, _ in tables.trainings(cases)] == [
        f"r/ppo, training {k}" for k in range(3)
    ]
    assert tables.build_rows(cases)[1].learning == "each 2.00 k steps"


# Folders as agents


def folder_with(folder, name="policy.json", seeds=(0, 10, 2)):
    for seed in seeds:
        (folder / f"seed-{seed}").mkdir(parents=True, exist_ok=True)
        (folder / f"seed-{seed}" / name).write_text("{}")
    return folder


def test_a_spec_of_a_folder_becomes_one_for_each_training(tmp_path):
    folder = folder_with(tmp_path / "ppo")
    (folder / "seed-1").mkdir()
    found = expanded({"agent": f"{folder}/", "seed": 3})
    assert found == [
        {"agent": str(folder / f"seed-{k}" / "policy.json"), "seed": 3} for k in (0, 2, 10)
    ]
    assert {tables.label_of(case) for case in found} == {str(folder)}
    tuned = folder_with(tmp_path / "tuned", "weights.json", (1,))
    weights = {"weights": str(tuned / "seed-1" / "weights.json")}
    spec = {"agent": str(tuned), "agent_settings": {"threads": 1}}
    assert expanded(spec) == [
        {"agent": "lpv-nmpc-tuned", "agent_settings": {"threads": 1, **weights}}
    ]
    assert expanded({"agent": "stanley"}) == [{"agent": "stanley"}]
    with pytest.raises(ValueError, match="leave out --agent-set weights"):
        expanded({"agent": str(tuned), "agent_settings": {"weights": "paired"}})


def test_a_folder_called_like_a_shipped_agent_is_another_agent(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder_with(Path("ppo"), seeds=(0,))
    assert expanded({"agent": "ppo"}) == [{"agent": "ppo"}]
    (own,) = expanded({"agent": "./ppo"})
    assert own == {"agent": str(Path("ppo/seed-0/policy.json"))}
    assert tables.label_of(own) == "./ppo"


@pytest.mark.parametrize("files", [[], ["policy.json", "weights.json"]])
def test_a_folder_that_is_no_agent_is_refused_in_a_line(tmp_path, files, capsys):
    for name in files:
        folder_with(tmp_path, name)
    words = ["benchmark", "--agents", str(tmp_path), "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "seed-N/policy.json" in line
    assert "seed-N/weights.json" in line


def test_a_folder_that_is_not_there_is_named(tmp_path, capsys):
    words = ["benchmark", "--agents", "results/pop", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    message = "lpv-track: agent 'results/pop': there is no such folder of trainings\n"
    assert capsys.readouterr().err == message


@pytest.mark.parametrize("words", [["drive", "--frames", "f"], ["ablation"], ["highway"]])
def test_other_commands_take_one_policy_file(tmp_path, words, capsys):
    pytest.importorskip("highway_env")
    folder = folder_with(tmp_path / "ppo")
    out = [] if words[0] == "drive" else ["--out", str(tmp_path / "out")]
    assert cli.main([*words, "--agent", str(folder), *out]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "is a folder: give one policy file" in line


def test_benchmark_drives_every_training_of_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # a long name would break the table's title
    for seed in (0, 1):
        weights = WeightSchedule(CurvatureBands(), (TrackingWeights(Q=(1, 1, 5 + seed, 5)),) * 4)
        (tmp_path / "tuned" / f"seed-{seed}").mkdir(parents=True)
        weights.write(tmp_path / "tuned" / f"seed-{seed}" / "weights.json")
    tuned, out = "tuned", Path("out")
    words = ["benchmark", "--agents", tuned, "--trajectories", "u-turn", "--workers", "1"]
    words += ["--agent-set", f"{tuned}:delay_compensation=false", "--env", "time_limit=1"]
    assert cli.main([*words, "--start", "lateral_error=0.5", "--out", str(out)]) == 0
    assert tables.SPREADS in capsys.readouterr().out
    cases = ResultStore(out).cases([])
    assert [tables.training_of(case) for case in cases] == [0, 1]
    assert {tables.label_of(case) for case in cases} == {f"{tuned} (delay_compensation=False)"}
    assert len({case["metrics"]["ale"] for case in cases}) == 2
