"""A tuning that was interrupted, killed or damaged: it goes on bit for bit, or says why not."""

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.small_tunings import SMALL, STEPS, Counted, bits, progress, refusal, tuned, words

pytest.importorskip("stable_baselines3")
pytest.importorskip("cma")
import torch

from experiments import cli
from experiments.jobs import checkpoint
from experiments.jobs.job import locked
from experiments.tuning import loop
from experiments.tuning.paired import STATE as PAIRED
from experiments.tuning.search import STATE
from experiments.tuning.tuner import Tuner
from lpv_track_env.vehicle import VEHICLES

RESUMED = ("search", "paper", "gradient", "rl", "paired")
"""Those whose files differ in kind."""


def state_of(method: str) -> str:
    if method == "paired":
        return PAIRED
    return checkpoint.NAME if method in {"rl", "catalogue"} else STATE


def interrupted(method: str, folder: Path, *more: str, steps: float = STEPS) -> None:
    assert cli.main([*words(method, *more, steps=steps), "--out", str(folder)]) == 130
    assert not (folder / "weights.json").exists()


@pytest.mark.parametrize("method", SMALL)
def test_interrupted_anywhere_it_ends_as_if_it_was_not(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    # Enough to be interrupted after two generations: searches of several classes take turns.
    whole = tuned(method, tmp_path / "whole", steps=5)
    drives = counted.calls

    out = tmp_path / "parts"
    # In the first step: nothing is kept yet.
    counted.calls, counted.interrupted_at = 0, 1
    interrupted(method, out, steps=5)
    assert not (out / state_of(method)).exists()
    # Between the first step's line and its state.
    made = loop.make_tuner

    def unsaved(*given: Any) -> Tuner:
        tuner = made(*given)

        def save(_: Path) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(tuner, "save", save)
        return tuner

    with monkeypatch.context() as patched:
        patched.setattr(loop, "make_tuner", unsaved)
        interrupted(method, out, "--resume", steps=5)
        assert (out / "progress.jsonl").exists()
        assert not (out / state_of(method)).exists()
    # In a later step.
    counted.calls, counted.interrupted_at = 0, drives // 2 + 1
    interrupted(method, out, "--resume", steps=5)
    assert (out / state_of(method)).exists()
    kept = len((out / "progress.jsonl").read_text().splitlines())
    assert kept >= 2
    # Between the next step's line and its state.
    with monkeypatch.context() as patched:
        patched.setattr(loop, "make_tuner", unsaved)
        interrupted(method, out, "--resume", steps=5)
        assert len((out / "progress.jsonl").read_text().splitlines()) == kept + 1
    counted.interrupted_at = -1
    parts = tuned(method, out, "--resume", steps=5)
    assert bits(parts) == bits(whole)
    assert progress(parts) == progress(whole)


KILLED = """
import os, signal, sys
from pathlib import Path
from experiments import cli

replace, count = os.replace, 0


def killed(source, target):
    global count
    count += Path(target).name == sys.argv[1]
    if count == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)


os.replace = killed
cli.main(sys.argv[2:])
"""


@pytest.mark.parametrize(("method", "file"), [("bands", STATE), ("catalogue", "progress.jsonl")])
def test_killed_while_it_writes_it_goes_on_bit_for_bit(
    method: str, file: str, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    path = os.pathsep.join([str(Path(cli.__file__).parents[1]), *sys.path])
    process = subprocess.run(
        [sys.executable, "-c", KILLED, file, *words(method), "--out", str(out)],
        env={**os.environ, "PYTHONPATH": path}, capture_output=True, check=False,
    )  # fmt: skip
    assert process.returncode == -signal.SIGKILL, process.stderr
    assert not (out / "weights.json").exists()
    kept = len((out / "progress.jsonl").read_text().splitlines())
    assert kept == (2 if file == STATE else 1)
    resumed, whole = tuned(method, out, "--resume"), tuned(method, tmp_path / "whole")
    assert bits(resumed) == bits(whole)
    assert progress(resumed) == progress(whole)


@pytest.fixture(name="half", params=RESUMED)
def fixture_half(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[str, Path, Path]:
    """A method, the weights that it comes to, and a folder in which it is halfway there."""
    method: str = request.param
    counted = Counted(monkeypatch)
    whole = tuned(method, tmp_path / "whole")
    counted.calls, counted.interrupted_at = 0, counted.calls // 2 + 1
    interrupted(method, tmp_path / "half")
    counted.interrupted_at = -1
    return method, whole, tmp_path / "half"


def test_a_state_that_cannot_be_used_is_one_line_and_its_advice_helps(
    half: tuple[str, Path, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    method, whole, out = half
    file = out / state_of(method)
    good = file.read_bytes()
    if file.name == STATE:
        kept = json.loads(good)
        other = json.loads((tmp_path / "whole" / STATE).read_text())
        texts = [
            "", "[]", "null", "{}", '{"format": "lpv-track-search/0"}', "[" * 100_000,
            json.dumps({"format": kept["format"]}), good[: len(good) // 2].decode(),
            good.decode().replace("[[", "[[1.0, ", 1), good.decode().replace("[[", "[[NaN, ", 1),
            good.decode().replace("[[", "[3.0, [", 1), good.decode().replace("[[", '[["a", ', 1),
            json.dumps({**other, "solves": None, "straight": None}),
        ]  # fmt: skip
        bad = [*(text.encode() for text in texts), b"\xff\xfe", bytes(100)]
    elif file.name == PAIRED:
        with np.load(io.BytesIO(good)) as content:
            arrays = dict(content)
        numbers = arrays["numbers"]
        foreign = [
            {}, {**arrays, "policy": arrays["policy"][:1]}, {**arrays, "numbers": numbers[:-1]},
            {**arrays, "squares": np.nan * arrays["squares"]},
            {**arrays, "mean": arrays["mean"].astype(object)},
            {**arrays, "numbers": numbers.astype(np.int64)},
        ]  # fmt: skip
        bad = [b"", good[: len(good) // 2], b"{}", bytes(100)]
        for content in foreign:
            buffer = io.BytesIO()
            np.savez(buffer, **content)
            bad.append(buffer.getvalue())
    else:
        kept = torch.load(file, weights_only=True)
        bad = [b"", good[:-1], good[: len(good) // 2], b"{}"]
        networks = kept["parameters"]
        narrow = {key: value[:1] for key, value in networks["policy"].items()}
        foreign = [
            {}, {**kept, "parameters": {}}, {**kept, "solves": "many"}, {**kept, "segment": None},
            {**kept, "parameters": {**networks, "policy": narrow}},
            {**kept, "parameters": {**networks, "policy": {}}},
        ]  # fmt: skip
        for content in foreign:
            checkpoint.write(out, {**content, "format": checkpoint.FORMAT})
            bad.append(file.read_bytes())
    for content in bad:
        file.write_bytes(content)
        error = refusal(capsys, *words(method, "--resume"), "--out", str(out))
        assert str(file) in error, content[:80]
        assert "remove it" in error
    file.unlink()
    assert bits(tuned(method, out, "--resume")) == bits(whole)


def test_other_files_that_cannot_be_used_are_one_line(
    half: tuple[str, Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    method, whole, out = half
    for name, contents in (
        ("progress.jsonl", ("", "{", "[]\n", "null\n", '{"step": 0}\n', '{"solves": "few"}\n')),
        ("settings.json", ("", "{", "[]", "null", "\0")),
    ):
        good = (out / name).read_text()
        for content in contents:
            (out / name).write_text(content)
            error = refusal(capsys, *words(method, "--resume"), "--out", str(out))
            assert str(out) in error, content
        (out / name).write_text(good)
    (out / "progress.jsonl").unlink()
    assert "progress.jsonl" in refusal(capsys, *words(method, "--resume"), "--out", str(out))
    (out / "progress.jsonl").write_bytes((whole.parent / "progress.jsonl").read_bytes())
    assert bits(tuned(method, out, "--resume")) == bits(whole)


def test_other_settings_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    car = tmp_path / "car.json"
    car.write_text(json.dumps(VEHICLES["m2-minibus"].as_dict()))
    own = ["--vehicle", str(car), "--conditions-set", "steering_lag=0.1"]
    weights = tuned("search", tmp_path / "out", *own)
    common = [*words("search", *own), "--out", str(weights.parent)]
    assert "--resume" in refusal(capsys, *common)
    before = weights.read_bytes()
    for given, said in (
        (["--seed", "1"], "seed is 1, there 0"),
        (["--solves", "999"], "solves is 999, there 270"),
        (["--method", "gradient"], "method is 'gradient', there 'search'"),
        (["--set", "sigma=0.5"], "hyperparameters is {'sigma': 0.5}, there {'sigma': 1.0}"),
        (["--conditions-set", "steering_lag=0.2"], "conditions is"),
        (["--vehicle", "m2-minibus"], "vehicle is 'm2-minibus'"),
        (["--time-limit", "0.6"], "time_limit is 0.6, there 0.5"),
    ):
        assert said in refusal(capsys, *common, "--resume", *given)
    car.write_text(json.dumps(VEHICLES["course-car"].as_dict()))
    assert "files is" in refusal(capsys, *common, "--resume")
    assert weights.read_bytes() == before


def test_a_tuning_at_its_end_stays_as_it_is(tmp_path: Path) -> None:
    for method in (*RESUMED, "fixed"):
        weights = tuned(method, tmp_path / method)
        found = bits(weights)
        assert bits(tuned(method, tmp_path / method, "--resume")) == found


def test_one_process_tunes_in_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with locked(tmp_path):
        error = refusal(capsys, *words("search"), "--out", str(tmp_path))
    assert "another process" in error
    assert not (tmp_path / "settings.json").exists()
    tuned("search", tmp_path)
