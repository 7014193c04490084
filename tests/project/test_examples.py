"""Every script of examples/ runs as its page says, and prints what that says."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SHORT = {
    "compare_agents": ["--seeds", "2", "--agents", "lpv-nmpc", "stanley", "--workers", "1"],
    "train_ppo": ["--steps", "4096", "--envs", "64"],
    "tune_weights": ["--candidates", "4", "--drives", "4", "--seconds", "4"],
    "parallel_vector_env": ["--envs", "64", "--steps", "100"],
    "cleanrl_style_ppo": ["--steps", "80000"],
    "torchrl_ppo": ["--steps", "81920"],
    "skrl_ppo": ["--steps", "80000"],
    "tianshou_ppo": ["--steps", "20000"],
    "rllib_ppo": ["--steps", "20000"],
}
NEEDS = {
    "train_ppo": "stable_baselines3", "highway_traffic": "highway_env",
    "cleanrl_style_ppo": "torch", "torchrl_ppo": "torchrl", "skrl_ppo": "skrl",
    "tianshou_ppo": "tianshou", "rllib_ppo": "tree", "dompc_agent": "do_mpc",
}  # fmt: skip
"""Modules without which an example is skipped; Tianshou and Ray want environments of their own."""
"""Arguments that make an example short; the others are short as they are."""
NUMBER = r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)"


def printed(name: str, folder: Path, *more: str) -> str:
    if name in NEEDS and find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed: see docs/libraries.md")
    words = [sys.executable, ROOT / "examples" / f"{name}.py", *SHORT.get(name, []), *more]
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, check=False, timeout=300,
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(pattern: str, text: str) -> list[float]:
    found = re.findall(pattern.replace("NUMBER", NUMBER), text)
    assert found, f"{pattern!r} not in {text!r}"
    return [float(value) for value in found]


def first_drive(text: str) -> None:
    assert "end: finished after 513 m" in text
    assert numbers("largest lateral error: NUMBER m", text)[0] <= 0.016


def own_agent(text: str) -> None:
    rows = [line.split() for line in text.splitlines()[1:]]
    assert [row[:3] for row in rows] == [
        [path, agent, "finished"]
        for path in ("T2", "u-turn") for agent in ("Proportional", "lpv-nmpc")
    ]  # fmt: skip
    assert all(float(own[3]) < 0.5 and float(nmpc[3]) < 0.02 for own, nmpc in [rows[:2], rows[2:]])


def own_path(text: str) -> None:
    assert [line.split(":")[0] for line in text.splitlines()] == [
        "segments-path.csv", "waypoints-path.csv", "clothoid-path.csv",
    ]  # fmt: skip
    assert text.count("finished") == 3
    assert max(numbers("lateral error NUMBER m", text)) < 0.02


def highway_traffic(text: str) -> None:
    assert "lpv-nmpc on racetrack: finished" in text
    assert numbers("lateral error NUMBER m rms", text)[0] < 0.01
    assert numbers("least gap NUMBER m", text)[0] > 4.0


def own_vehicle(text: str) -> None:
    empty, full = numbers("finished, MLE NUMBER m", text)
    assert empty != full
    assert max(empty, full) < 0.02
    # K = m (lr Car - lf Caf) / (L Caf Car)
    gradient = (3500 + 825) * (1.7 * 110e3 - 1.6 * 90e3) / (3.3 * 90e3 * 110e3)
    assert numbers("full bus: NUMBER", text)[0] == pytest.approx(gradient, abs=5.1e-6)


def compare_agents(text: str) -> None:
    assert [line.split()[0] for line in text.splitlines()] == ["lpv-nmpc", "stanley"]
    assert all(0.01 < ale < 0.06 for ale in numbers("ALE NUMBER m", text))


def realtime_conditions(text: str) -> None:
    lateral, noisier = numbers("lateral error NUMBER m", text)
    assert 0.01 < lateral < 0.06 < noisier
    assert text.count("finished") == 2


def train_ppo(text: str) -> None:
    # Two rollouts teach nothing: what counts is that the policy is written, read and drives.
    assert re.search(r"mine.json: \w+, \d+% of T2", text)


def tune_weights(text: str) -> None:
    [default], [best] = numbers("weights score NUMBER", text), numbers("of 4 scores NUMBER", text)
    assert 1.0 < best <= default < 25.0
    assert numbers("NUMBER solves", text)[0] == 4 * 4 * 4 / 0.05


def parallel_vector_env(text: str) -> None:
    assert text.rstrip().endswith("seed 10: True")


def horizon(text: str) -> None:
    assert text.startswith("SUCCESS")
    # 0.3 m beside the path now, back on it within the second.
    offsets = numbers("ahead, +NUMBER m to the left", text)
    assert offsets[0] == 0.3
    assert abs(offsets[-1]) < 0.05


def derivatives(text: str) -> None:
    assert numbers("states: NUMBER", text)[0] < 1e-12
    # dY'/dpsi = vx cos(psi) - vy sin(psi)
    assert numbers("NUMBER in the Jacobian", text)[0] == 7.613
    assert numbers("NUMBER in A", text)[0] == 0.0


def learns(text: str) -> None:
    [before], [after] = numbers("return before: NUMBER", text), numbers("steps: NUMBER", text)
    assert before < -20.0
    assert after > before + 5.0


def drives(text: str) -> None:
    rows = [line.split() for line in text.splitlines()[1:]]
    assert [row[2] for row in rows] == ["finished"] * 4
    assert all(float(own[4]) < 0.15 and float(nmpc[4]) < 0.02 for own, nmpc in [rows[:2], rows[2:]])


LIBRARIES = {
    **dict.fromkeys(
        ("cleanrl_style_ppo", "torchrl_ppo", "skrl_ppo", "tianshou_ppo", "rllib_ppo"), learns
    ),
    "casadi_agent": drives, "dompc_agent": drives,
}  # fmt: skip
"""Scripts of docs/libraries.md; the others are in docs/examples.md."""
CHECKS = LIBRARIES | {
    check.__name__: check
    for check in (
        first_drive, own_agent, own_path, own_vehicle, compare_agents, realtime_conditions,
        highway_traffic, train_ppo, tune_weights, parallel_vector_env, horizon, derivatives,
    )
}  # fmt: skip


@pytest.mark.parametrize("name", [file.stem for file in EXAMPLES])
def test_example_prints_what_its_page_says(name: str, tmp_path: Path) -> None:
    text = printed(name, tmp_path)
    assert text.strip()
    assert name in CHECKS, f"add to CHECKS what examples/{name}.py should print"
    CHECKS[name](text)


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_example_is_on_its_page_and_no_longer_than_a_page(file: Path) -> None:
    page, most = ("libraries", 120) if file.stem in LIBRARIES else ("examples", 80)
    assert f'--8<-- "examples/{file.name}"' in (ROOT / "docs" / f"{page}.md").read_text()
    assert len(file.read_text().splitlines()) <= most
