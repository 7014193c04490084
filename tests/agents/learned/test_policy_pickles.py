"""Policy files with pickles in them: nothing is run, though the payloads would leave a mark."""

import base64
import json
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import gymnasium
import pytest

import agents
from experiments.cli import main
from tests.helpers.policy_files import (
    DRIVING,
    Payload,
    PolicyKind,
    each_kind,
    put_weights,
    refusal,
)


@pytest.fixture
def file(kind: PolicyKind, tmp_path: Path) -> Path:
    return kind.written(tmp_path)


@each_kind
def test_a_pickle_in_place_of_the_weights_is_not_run(
    kind: PolicyKind, file: Path, tmp_path: Path
) -> None:
    torch = pytest.importorskip("torch")
    marker = tmp_path / "was-run"
    torch.save({"layers.0.weight": Payload(marker)}, tmp_path / "weights.pt")
    for content in ((tmp_path / "weights.pt").read_bytes(), pickle.dumps(Payload(marker))):
        put_weights(file, content)
        for by in kind.readers:
            assert "is not safetensors" in refusal(file, by)
    assert not marker.exists()
    # The payload is real.
    torch.load(tmp_path / "weights.pt", weights_only=False)
    assert marker.is_dir()


@each_kind
def test_a_pickle_in_place_of_the_spec_is_not_run(
    kind: PolicyKind, file: Path, tmp_path: Path
) -> None:
    marker = tmp_path / "was-run"
    for protocol in (0, 4):
        file.write_bytes(pickle.dumps(Payload(marker), protocol=protocol))
        for by in kind.readers:
            refusal(file, by)
    assert not marker.exists()
    pickle.loads(file.read_bytes())  # noqa: S301
    assert marker.is_dir()


@each_kind
def test_reading_unpickles_nothing_and_loads_no_torch(kind: PolicyKind, file: Path) -> None:
    for by in kind.readers:
        code = (
            "import sys\n"
            f"from {by.__module__} import {by.__name__}\n"
            "found = []\n"
            "hook = lambda event, _: found.append(event) if 'pickle' in event else None\n"
            "sys.addaudithook(hook)\n"
            f"{by.__name__}({str(file)!r})\n"
            "print(found, sorted({'torch', 'stable_baselines3', 'casadi'} & set(sys.modules)))\n"
        )
        assert printed(code) == ["[]", "[]"]


def printed(code: str) -> list[str]:
    """Words that a fresh interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


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
    assert "import-policy" in refusal(model, DRIVING.read)
    with pytest.raises(ValueError, match="import-policy"):
        agents.make(str(model), gymnasium.make("lpv_track_env/PathTracking-v0"))
    (tmp_path / "model.json").write_bytes(model.read_bytes())
    refusal(tmp_path / "model.json", DRIVING.read)
    put_weights(file := DRIVING.written(tmp_path), model.read_bytes())
    refusal(file, DRIVING.read)
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


def test_driving_loads_no_torch(tmp_path: Path) -> None:
    code = (
        "import sys, gymnasium, agents, lpv_track_env\n"
        "env = gymnasium.make('lpv_track_env/PathTracking-v0', trajectory='straight')\n"
        f"agents.make({str(DRIVING.written(tmp_path))!r}, env).predict(env.reset()[0])\n"
        "print(sorted({'torch', 'stable_baselines3', 'casadi'} & set(sys.modules)))\n"
    )
    assert printed(code) == ["[]"]
