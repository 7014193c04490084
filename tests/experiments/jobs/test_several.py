"""Trainings and tunings of several seeds: the same as alone, resumable, failures apart."""

import io
import json
import shlex
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.progress import Progress

from experiments import cli
from experiments.jobs import several
from experiments.jobs.console import TrainingDisplay
from experiments.jobs.curves import TRAINING
from experiments.jobs.job import Listener, Settings, read_lines
from experiments.run.engines import Engine
from experiments.run.training_folders import trainings_in
from tests.helpers.small_tunings import tuned, words

TIMES = ("seconds", "written", "digest")
"""Entries that differ between two runs; the digest is of all others, times included."""


def content(file: Path) -> Any:
    """Content of a result's file without times."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(one) for key, one in value.items() if key not in TIMES}
        return value

    return plain(json.loads(file.read_text()))


def tune(folder: Path, *more: str) -> list[str]:
    return [*words("search", "--workers", "1", *more), "--out", str(folder)]


def line_of(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_trainings_side_by_side_have_the_bits_of_those_alone(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    from experiments.training.loop import train
    from experiments.training.settings import TrainingSettings, usual

    def job_of(own: Namespace) -> tuple[Settings, str]:
        settings = usual(
            "ppo", steps=512, segment=256, envs=16, paths=1, validation=1, time_limit=3.0,
            conditions=("simulation",), hyperparameters={"rollout": 16, "batch": 64}, seed=own.seed,
        )  # fmt: skip
        return settings, f"lpv-track train ppo --seed {own.seed}"

    def display(settings: TrainingSettings, progress: Progress, prefix: str) -> TrainingDisplay:
        return TrainingDisplay(console, "ppo", settings.steps, progress, prefix)

    def finished(_settings: Any, folder: Path) -> bool:
        return (folder / "progress.jsonl").exists() and len(read_lines(folder)) >= 2

    # First, so that the other processes find compiled functions on disk.
    settings, command = job_of(Namespace(seed=7))
    alone = tmp_path / "alone"
    train(settings, alone, Listener(), command=command)  # type: ignore[arg-type]
    console = Console(file=io.StringIO(), width=120)
    options = Namespace(out=tmp_path / "both", resume=False, start=None)
    kind = several.Kind("training", train, display, finished, TRAINING, "steps")
    assert several.run_seeds(kind, options, [0, 7], job_of, Engine(2), console) == 0
    ours = tmp_path / "both" / "seed-7"
    (weights,) = ours.glob("*.safetensors")
    assert weights.read_bytes() == (alone / weights.name).read_bytes()
    assert content(ours / "policy.json") == content(alone / "policy.json")
    written = console.file.getvalue()  # type: ignore[attr-defined]
    for seed in (0, 7):
        assert sum(f"seed {seed}: " in line for line in written.splitlines()) == 2
    assert (options.out / "training.png").stat().st_size > 10_000


def test_tunings_of_several_seeds_are_those_alone_and_make_one_agent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cma")
    both = tmp_path / "both"
    assert cli.main(tune(both, "--seeds", "3", "1")) == 0
    assert "seed 3: " in (text := capsys.readouterr().out)
    assert f"2 of 2 tunings: {both}" in " ".join(text.split())
    assert (both / "tuning.png").is_file()
    assert trainings_in(str(both)) == [both / f"seed-{k}" / "weights.json" for k in (1, 3)]
    alone = tuned("search", tmp_path / "alone", "--seed", "3")
    assert content(both / "seed-3" / "weights.json") == content(alone)
    command = shlex.split(content(alone)["provenance"]["command"])
    assert command[command.index("--seed") + 1] == "3"
    assert "--seeds" not in command


def test_finished_seeds_are_skipped_and_others_join(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cma")
    assert cli.main(tune(tmp_path, "--seeds", "0")) == 0
    before = (tmp_path / "seed-0" / "weights.json").stat().st_mtime_ns
    assert cli.main(tune(tmp_path, "--seeds", "0", "1")) == 2
    assert "holds a tuning already: say --resume" in line_of(capsys)
    assert cli.main(tune(tmp_path, "--seeds", "0", "1", "--resume")) == 0
    assert "finished already: seed 0" in capsys.readouterr().out
    assert (tmp_path / "seed-0" / "weights.json").stat().st_mtime_ns == before
    assert (tmp_path / "seed-1" / "weights.json").is_file()
    other = [*tune(tmp_path, "--seeds", "0", "1", "--resume"), "--span", "7"]
    assert cli.main(other) == 2
    assert "with other settings: span is 7" in line_of(capsys)


def test_a_seed_that_fails_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cma")
    assert cli.main(tune(tmp_path, "--seeds", "0", "1")) == 0
    (tmp_path / "seed-0" / "weights.json").unlink()
    (tmp_path / "seed-0" / "search.json").write_text("{")
    capsys.readouterr()
    assert cli.main(tune(tmp_path, "--seeds", "0", "1", "2", "--resume")) == 1
    text = " ".join(capsys.readouterr().out.split())
    assert "seed 0 failed: ValueError: " in text
    assert "2 of 3 tunings" in text
    assert (tmp_path / "seed-2" / "weights.json").is_file()
    for seed in (1, 2):
        (tmp_path / f"seed-{seed}" / "weights.json").unlink()
        (tmp_path / f"seed-{seed}" / "search.json").write_text("{")
    assert cli.main(tune(tmp_path, "--seeds", "0", "1", "2", "--resume")) == 1
    assert "benchmark" not in capsys.readouterr().out  # there is nothing to drive with


def test_ctrl_c_leaves_every_seed_resumable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cma")
    from experiments.tuning import search

    steps = []

    def interrupted(self: Any) -> dict[str, float]:
        steps.append(self.settings.seed)
        if steps == [0, 0, 0, 1, 1]:
            raise KeyboardInterrupt
        return step(self)

    step = search.CmaSearch.step
    monkeypatch.setattr(search.CmaSearch, "step", interrupted)
    assert cli.main(tune(tmp_path / "both", "--seeds", "0", "1")) == 130
    assert "interrupted: the same command with --resume goes on" in capsys.readouterr().out
    assert len(read_lines(tmp_path / "both" / "seed-1")) == 1
    assert cli.main(tune(tmp_path / "both", "--seeds", "0", "1", "--resume")) == 0
    alone = tuned("search", tmp_path / "alone", "--seed", "1")
    assert content(tmp_path / "both" / "seed-1" / "weights.json") == content(alone)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--seed", "1", "--seeds", "2"], "not allowed with"),
        (["--seeds", "1", "2", "1"], "--seeds names a seed twice: 1 2 1"),
        (["--seeds", "1000"], "--seeds must be"),
        (["--workers", "2"], "are for several seeds: give --seeds"),
        (["--address", "auto", "--seeds", "1"], "needs --engine ray"),
    ],
)
def test_impossible_seeds_are_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    assert cli.main([*words("search", *more), "--out", str(tmp_path / "out")]) == 2
    assert message in line_of(capsys)
    assert not (tmp_path / "out").exists()


def test_hours_are_the_budget_of_one_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("stable_baselines3")
    given = ["train", "ppo", "--seeds", "1", "2", "--hours", "1", "--out", str(tmp_path / "out")]
    assert cli.main(given) == 2
    assert "give --steps with --seeds" in line_of(capsys)


def test_a_training_starts_from_that_of_its_seed(tmp_path: Path) -> None:
    file = tmp_path / "bc" / "seed-4" / "policy.json"
    file.parent.mkdir(parents=True)
    file.write_text("{}")
    assert several.start_of(str(tmp_path / "bc"), 4) == str(file)
    assert several.start_of(str(file), 3) == str(file)
    assert several.start_of(None, 3) is None
    with pytest.raises(ValueError, match=r"has no seed-3.policy\.json: give a folder"):
        several.start_of(str(tmp_path / "bc"), 3)
