"""Policy files with pickles in them: nothing is run, though the payloads would leave a mark."""

import base64
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import agents
from experiments.cli import main
from tests.helpers.learned_policies import put_weights, refusal, written


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return written(tmp_path)


class Payload:
    """What a pickle runs when it is loaded: here it makes a folder."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.marker,)


def test_a_pickle_in_place_of_the_weights_is_not_run(file: Path, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    marker = tmp_path / "was-run"
    torch.save({"features.weight": Payload(marker)}, tmp_path / "weights.pt")
    content = (tmp_path / "weights.pt").read_bytes()
    put_weights(file, content)
    assert "is not safetensors" in refusal(file)
    put_weights(file, pickle.dumps(Payload(marker)))
    assert "is not safetensors" in refusal(file)
    assert not marker.exists()
    # The payload is real.
    torch.load(tmp_path / "weights.pt", weights_only=False)
    assert marker.is_dir()


def test_a_pickle_in_place_of_the_spec_is_not_run(file: Path, tmp_path: Path) -> None:
    marker = tmp_path / "was-run"
    for protocol in (0, 4):
        file.write_bytes(pickle.dumps(Payload(marker), protocol=protocol))
        refusal(file)
    assert not marker.exists()
    pickle.loads(file.read_bytes())  # noqa: S301
    assert marker.is_dir()


@pytest.fixture(scope="module")
def infected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A model of SB3 that makes a folder when it is loaded, and that folder."""
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    folder = tmp_path_factory.mktemp("infected")
    env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory="straight")
    model = stable_baselines3.PPO(
        "MlpPolicy", env, n_steps=8, batch_size=8, policy_kwargs={"net_arch": [4]}, device="cpu"
    )
    model.payload = Payload(folder / "was-run")
    model.save(folder / "model.zip")
    with zipfile.ZipFile(folder / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    assert b"mkdir" in base64.b64decode(data["payload"][":serialized:"])
    return folder / "model.zip", folder / "was-run"


def test_a_model_of_sb3_is_not_loaded_without_trust(
    infected: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, marker = infected
    out = tmp_path / "mine.json"
    assert main(["import-policy", str(model), "--algorithm", "ppo", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "runs code" in said
    assert "--trust" in said
    assert "import-policy" in refusal(model)
    with pytest.raises(ValueError, match="import-policy"):
        agents.make(str(model), gymnasium.make("lpv_track_env/PathTracking-v0"))
    (tmp_path / "model.json").write_bytes(model.read_bytes())
    refusal(tmp_path / "model.json")
    put_weights(file := written(tmp_path), model.read_bytes())
    refusal(file)
    assert not marker.exists()
    # The payload is real: SB3's own way of loading runs it.
    import stable_baselines3

    stable_baselines3.PPO.load(model, device="cpu")
    assert marker.is_dir()


def test_without_trust_a_model_is_not_even_looked_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        str(tmp_path / "none.zip"),
        "--algorithm",
        "ppo",
        "--out",
        str(tmp_path / "a.json"),
    ]
    assert main(["import-policy", *arguments]) == 2
    assert "say --trust" in capsys.readouterr().err
    assert main(["import-policy", *arguments, "--trust"]) == 2
    assert "there is no file" in capsys.readouterr().err


def test_reading_and_driving_load_no_torch_and_unpickle_nothing(file: Path) -> None:
    code = (
        "import sys\n"
        "from agents.learned import read\n"
        "found = []\n"
        "sys.addaudithook(lambda event, _: found.append(event) if 'pickle' in event else None)\n"
        f"read({str(file)!r})\n"
        "print(found)\n"
        "import gymnasium, agents, lpv_track_env\n"
        "env = gymnasium.make('lpv_track_env/PathTracking-v0', trajectory='straight')\n"
        f"agents.make({str(file)!r}, env).predict(env.reset()[0])\n"
        "print(sorted({'torch', 'stable_baselines3', 'casadi'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.split() == ["[]", "[]"], done.stderr
