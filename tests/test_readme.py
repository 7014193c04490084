"""What the README says about learning, run as it stands but shorter."""

import re
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

README = (Path(__file__).parents[1] / "README.md").read_text()
SHORTER = {
    "300_000": "4096", "3_000_000": "2048", "num_envs=512": "num_envs=16", "range(20)": "range(2)",
    "batch_size=4096": "batch_size=512",
}  # fmt: skip


def learning_blocks() -> list[str]:
    section = README[README.index("### Train your own") : README.index("### Files")]
    return re.findall(r"```python\n(.*?)```", section, re.DOTALL)


def test_policies_of_the_readme_are_trained_written_and_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from experiments.cases import run_case
    from experiments.cli import main

    monkeypatch.chdir(tmp_path)
    plain, fast = learning_blocks()
    text = plain + "\n" + fast
    for word, shorter in SHORTER.items():
        text = text.replace(word, shorter)
    exec(compile(text, "README.md", "exec"), {})  # noqa: S102  our own text
    assert main(["import-policy", "mine.zip", "--algorithm", "ppo", "--trust",
                 "--out", "plain.json"]) == 0  # fmt: skip
    for file in ("mine.json", "plain.json"):
        result = run_case({"agent": file, "trajectory": "u-turn"})
        assert result["status"] == "ok", result.get("error")
        assert result["training"]["algorithm"] in {"mine", "ppo"}
    assert len(plain.strip().splitlines()) == 6
