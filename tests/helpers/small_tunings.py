"""Tunings of a second or less, for tests of `lpv-track tune`."""

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.policy import WeightPolicy, load
from agents.weights import WeightSchedule
from experiments import cli

PPO = ["rollout=4", "batch=8", "epochs=2", "hidden=[8]", "segment=64"]
# What makes a method small, and the most solves that one of its steps takes: candidates or pairs,
# times drives, times ten control periods; PPO's window has eight.
SMALL: dict[str, tuple[list[str], int]] = {
    "paper": (
        ["--drives", "1", "--trajectories", "straight", "circle", "figure-eight"],
        3 * 9 * 10,
    ),
    "search": (["--drives", "1"], 9 * 10),
    "bands": (["--drives", "1"], 13 * 10),
    "gradient": (["--set", "pairs=2"], 4 * 10),
    "catalogue": (["--drives", "2", "--set", *PPO], 2 * 4 * 8),
    "rl": (["--drives", "2", "--set", *PPO], 2 * 4 * 8),
    "paired": (["--drives", "4"], 4 * 8),
}
STEPS = 3


def words(method: str, *more: str, steps: float = STEPS) -> list[str]:
    """Words of the command line: `steps` steps of a method, on short drives."""
    own, cost = SMALL.get(method, ([], 0))
    paths = [] if "--trajectories" in own else ["--trajectories", "circle", "sine"]
    return [
        "tune", "--method", method, "--conditions", "simulation", "--time-limit", "0.5",
        "--solves", str(max(int(steps * cost), 1)), *paths, *own, *more,
    ]  # fmt: skip


def tuned(method: str, folder: Path, *more: str, steps: float = STEPS) -> Path:
    """Weights that the command writes."""
    assert cli.main([*words(method, *more, steps=steps), "--out", str(folder)]) == 0
    return folder / "weights.json"


def again(weights: Path, folder: Path) -> Path:
    """Weights that the command in a file's provenance writes."""
    given = shlex.split(provenance(load(weights))["command"])
    assert given[0] == "lpv-track"
    assert cli.main([*given[1:], "--out", str(folder)]) == 0
    return folder / "weights.json"


def provenance(result: WeightSchedule | WeightPolicy) -> dict[str, Any]:
    return dict(result.training if isinstance(result, WeightPolicy) else result.provenance)


def bits(weights: Path) -> Any:
    """All of what was found, but for the seconds that it took."""
    result = load(weights)
    plain: Any = {**provenance(result), "seconds": None}
    if isinstance(result, WeightPolicy):
        layers = [array.tobytes() for layer in result.layers for array in layer]
        return layers, result.choice, result.layout, result.control_period, plain
    return {**result.as_dict(), "provenance": plain}


def progress(weights: Path) -> list[dict[str, Any]]:
    """Lines of the progress beside weights, but for the seconds."""
    text = (weights.parent / "progress.jsonl").read_text()
    return [{**json.loads(line), "seconds": None} for line in text.splitlines()]


def refusal(capsys: pytest.CaptureFixture[str], *given: str) -> str:
    """What a command that is refused says: one line."""
    capsys.readouterr()
    assert cli.main(list(given)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert len(error) < 1000, error
    return error


class Counted:
    """Solves and calls of every closed loop, whatever drives it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.solves = self.calls = 0
        self.interrupted_at = -1
        drive = ClosedLoop.drive

        def counted(loop: ClosedLoop, *given: Any, **named: Any) -> Tally:
            self.calls += 1
            if self.calls == self.interrupted_at:
                raise KeyboardInterrupt
            tally = drive(loop, *given, **named)
            self.solves += int(tally.solves.sum())
            return tally

        monkeypatch.setattr(ClosedLoop, "drive", counted)
