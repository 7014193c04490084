"""Policy files: what is read is what was written, or one line says why not; nothing is run."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from agents.learned import files, read, write
from agents.learned import policy as policies
from lpv_track_env import observation
from lpv_track_env.observation import ObservationLayout
from tests.helpers.learned_policies import (
    change,
    put_weights,
    random_policy,
    refusal,
    same,
    written,
)

POLICY = random_policy()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return written(tmp_path, POLICY)


# What is written is what is read.


@pytest.mark.parametrize("origin", ["zero", "actuators", "lpv-nmpc"])
@pytest.mark.parametrize(("activation", "squash"), [("tanh", "clip"), ("relu", "tanh")])
def test_round_trip_bit_for_bit(origin: str, activation: str, squash: str, tmp_path: Path) -> None:
    policy = random_policy(
        origin=origin, activation=activation, squash=squash, hidden=(5, 1, 300),
        symmetric=origin == "zero",
        layout=ObservationLayout(7, 0.1 + 0.2), control_period=1 / 30, feature_limit=1e30,
        centre=np.array([5e-324, -0.0]), half=np.array([0.0, 1 / 3]),
    )  # fmt: skip
    file = written(tmp_path, policy)
    assert same(read(file), policy)
    assert same(read(str(file)), policy)
    assert not list(tmp_path.glob(".*"))


def test_the_same_policy_is_the_same_bytes(tmp_path: Path) -> None:
    one, other = written(tmp_path / "a"), written(tmp_path / "b")
    for suffix in (".json", ".safetensors"):
        assert one.with_suffix(suffix).read_bytes() == other.with_suffix(suffix).read_bytes()


def test_a_policy_moves_with_its_two_files(file: Path, tmp_path: Path) -> None:
    shutil.copytree(file.parent, tmp_path / "elsewhere")
    assert same(read(tmp_path / "elsewhere" / file.name), POLICY)


def test_what_a_policy_holds_cannot_be_changed_from_outside() -> None:
    weight, training = np.ones((12, 48), dtype=np.float32), {"seed": [1]}
    policy = random_policy(feature_weight=weight, training=training)
    weight[:] = 2.0
    training["seed"].append(2)
    assert (policy.feature_weight == 1.0).all()
    assert policy.training == {"seed": [1]}
    with pytest.raises(ValueError, match="read-only"):
        policy.feature_weight[0, 0] = 3.0


def test_weights_are_there_before_a_spec_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    monkeypatch.setattr(files, "write_atomically", lambda file, _: order.append(file.suffix))
    write(POLICY, tmp_path / "mine.json")
    assert order == [".safetensors", ".json"]


@pytest.mark.parametrize("name", ["mine.safetensors", "mine", "mine.zip", "my:policy.json"])
def test_written_to_json_with_a_plain_name_only(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"{name}.* a policy"):
        write(POLICY, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_what_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    text = random_policy(training={"note": "x" * 2**20})
    with pytest.raises(ValueError, match="at most 1048576 are allowed"):
        write(text, tmp_path / "mine.json")
    large = random_policy(hidden=(4096, 4096))
    with pytest.raises(ValueError, match="at most 67108864 are allowed"):
        write(large, tmp_path / "mine.json")
    assert not list(tmp_path.iterdir())


# What makes no policy.


LAYERS = POLICY.layers


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"algorithm": ""}, "algorithm must be a name"),
        ({"control_period": 0.0}, "control_period must be in"),
        ({"control_period": "0.05"}, "control_period must be a number"),
        ({"feature_limit": 0.0}, "feature_limit must be positive"),
        ({"feature_limit": np.inf}, "feature_limit must be finite"),
        ({"feature_limit": 10**400}, "feature_limit must be finite"),
        ({"activation": "elu"}, "unknown activation 'elu'; known: tanh, relu"),
        ({"squash": "none"}, "unknown squash 'none'"),
        ({"origin": "stanley"}, "unknown origin 'stanley'"),
        ({"origin": "lpv-nmpc", "feature_weight": np.ones((12, 48))}, r"\(outputs, 50\), not"),
        ({"feature_weight": np.ones((12, 47))}, r"feature weight must have shape \(outputs, 48\)"),
        ({"feature_weight": np.ones(48)}, "feature weight must have shape"),
        ({"feature_bias": np.ones(11)}, r"feature bias must have shape \(12,\), not \(11,\)"),
        ({"feature_bias": np.full(12, 1e39)}, "feature bias has values that are not finite"),
        ({"feature_bias": ["1"] * 12}, "feature bias is not an array of numbers"),
        ({"centre": [0.0, np.nan]}, "centre has values that are not finite"),
        ({"centre": 0.0}, r"centre must have shape \(2,\), not \(\)"),
        ({"half": [0.1, -0.1]}, "half must not be negative"),
        ({"layers": ()}, "layers must be 1 to 16, not 0"),
        ({"layers": (*[(np.eye(12), np.ones(12))] * 16, LAYERS[0])}, "1 to 16, not 17"),
        ({"layers": LAYERS[:2]}, "last layer must have 2 outputs, for a and delta, not 8"),
        ({"layers": LAYERS[::2]}, r"layers\[1\] weight must have shape \(outputs, 16\)"),
        ({"layers": (LAYERS[0][0],)}, r"layers\[0\] must be a weight and a bias"),
        ({"feature_weight": np.ones((4097, 48)), "feature_bias": np.ones(4097)}, "1 to 4096"),
        ({"training": {"seed": np.float32(1.0)}}, "training must be plain JSON"),
        ({"training": {"score": float("nan")}}, "training must be plain JSON"),
        ({"training": {1: 2, "1": 3}}, "key '1' twice"),
        ({"training": [1]}, "training must be a mapping, not list"),
    ],
)
def test_what_is_no_policy_is_named(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as raised:
        random_policy(**changes)
    assert "\n" not in str(raised.value)


# Files that were changed.


@pytest.fixture(scope="module")
def whole() -> tuple[bytes, bytes]:
    """The two files of a policy."""
    with tempfile.TemporaryDirectory() as folder:
        file = written(Path(folder), random_policy(hidden=(3,)))
        return file.read_bytes(), file.with_suffix(".safetensors").read_bytes()


def put(folder: str, spec: bytes, weights: bytes) -> Path:
    file = Path(folder) / "mine.json"
    file.write_bytes(spec)
    file.with_suffix(".safetensors").write_bytes(weights)
    return file


@given(part=st.sampled_from([0, 1]), share=st.floats(0.0, 1.0, exclude_max=True))
@settings(max_examples=150, deadline=None)
def test_a_torn_file_is_refused_wherever_it_ends(
    whole: tuple[bytes, bytes], part: int, share: float
) -> None:
    torn = list(whole)
    torn[part] = whole[part][: int(share * len(whole[part]))]
    with tempfile.TemporaryDirectory() as folder:
        file = put(folder, *torn)
        if torn[part].strip() == whole[part].strip():
            read(file)  # the newline at the end of the spec
        else:
            refusal(file)


@given(
    part=st.sampled_from([0, 1]), share=st.floats(0.0, 1.0, exclude_max=True),
    flip=st.integers(1, 255),
)  # fmt: skip
@settings(max_examples=300, deadline=None)
@example(part=0, share=0.0, flip=0x80)
def test_a_changed_byte_is_refused_or_changes_nothing(
    whole: tuple[bytes, bytes], part: int, share: float, flip: int
) -> None:
    changed = list(whole)
    at = int(share * len(whole[part]))
    content = bytearray(whole[part])
    content[at] ^= flip
    changed[part] = bytes(content)
    with tempfile.TemporaryDirectory() as folder:
        file = put(folder, *changed)
        try:
            policy = read(file)
        except ValueError as error:
            assert "\n" not in str(error)  # noqa: PT017
            return
        # White space between the spec's tokens is nobody's.
        assert part == 0
        assert bytes([whole[0][at]]).isspace()
        assert same(policy, random_policy(hidden=(3,)))


def test_training_text_is_covered_too(file: Path) -> None:
    change(file, lambda spec: spec["training"].update(seed=4), digest=False)
    assert "was changed since it was written: copy it anew" in refusal(file)


def test_weights_of_another_policy_are_refused(file: Path, tmp_path: Path) -> None:
    other = written(tmp_path / "other", random_policy(seed=1))
    shutil.copy(other.with_suffix(".safetensors"), file.with_suffix(".safetensors"))
    said = refusal(file)
    assert "mine.safetensors was changed since it was written" in said
    assert "together with mine.json" in said


# Files that are something else.


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda s: s.update(format="lpv-track-policy/2"),
         "this version reads 'lpv-track-policy/1': retrain or upgrade"),
        (lambda s: s.pop("format"), "format is None"),
        (lambda s: s.update(extra=1), "unknown key 'extra'"),
        (lambda s: s.update({"x" * 999 + "\n": 1}), "unknown key 'xxx"),
        (lambda s: s.pop("half"), "no key 'half'"),
        (lambda s: s["layout"].pop("entries"), "no key 'layout.entries'"),
        (lambda s: s["weights"].update(url="x"), "unknown key 'weights.url'"),
        (lambda s: s.update(weights=[]), "weights must be an object"),
        (lambda s: s.update(layout=None), "layout must be an object"),
        (lambda s: s.update(activation="elu"), "unknown activation 'elu'"),
        (lambda s: s.update(activation={}), "unknown activation {}"),
        (lambda s: s.update(half=[0.1, -0.1]), "half must not be negative"),
        (lambda s: s.update(half=["1", "1"]), "half is not an array of numbers"),
        (lambda s: s.update(half=[10**400, 1]), "half is not an array of numbers"),
        (lambda s: s.update(centre=[[1.0], 1.0]), "centre is not an array of numbers"),
        (lambda s: s.update(control_period=10**400), "control_period must be finite"),
        (lambda s: s.update(training=[]), "training must be a mapping"),
        (lambda s: s["layout"].update(preview_steps=0), "preview_steps must be at least 1"),
        (lambda s: s["layout"].update(preview_steps=True), "must be an integer"),
        (lambda s: s["layout"].update(preview_steps=30), "of other entries (bounds or previews)"),
        (lambda s: s["layout"].update(digest="0"), "of other entries (bounds or previews)"),
        (lambda s: s["layout"].update(entries=None), "of other entries"),
        (lambda s: s["layout"]["entries"].pop(), "(7 scalar entries then, 8 now): retrain it"),
        (lambda s: s["layout"]["entries"].__setitem__(2, ["yaw_rate", "deg/s"]),
         "(['yaw_rate', 'deg/s'] then, ['yaw_rate', 'rad/s'] now): retrain it"),
        (lambda s: s["weights"].update(file="../mine.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file="..\\mine.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file="/etc/passwd"), "in the same folder"),
        (lambda s: s["weights"].update(file=".."), "in the same folder"),
        (lambda s: s["weights"].update(file="a\0.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file="a\nb.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file=7), "weights.file is 7"),
        (lambda s: s["weights"].update(file="mine-2.safetensors"), "there is no file"),
        (lambda s: s["weights"].update(file="mine" * 99 + ".safetensors"), "cannot read"),
        (lambda s: s["weights"].update(bytes=7), "7 were written: copy it anew"),
        (lambda s: s["weights"].update(sha256="0"), "was changed since it was written"),
    ],
)  # fmt: skip
def test_a_spec_that_says_something_else_is_refused(
    edit: Callable[[dict[str, Any]], Any], reason: str, file: Path
) -> None:
    change(file, edit)
    assert reason in refusal(file)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not a policy's JSON"),
        ("[]", "a JSON list, not an object"),
        ("[" * 100_000, "nested too deeply"),
        ('{"a": 1, "a": 2}', "key 'a' twice"),
        ('{"a": NaN}', "NaN is not JSON"),
        ('{"a": ' + "9" * 5000 + "}", "not a policy's JSON"),
    ],
)
def test_what_is_no_json_object_is_refused(text: str, reason: str, file: Path) -> None:
    file.write_text(text)
    assert reason in refusal(file)


def test_a_number_beyond_floats_is_refused(file: Path) -> None:
    file.write_text(file.read_text().replace('"seed": 3', '"seed": 3e999'))
    assert "not a policy's JSON" in refusal(file)


def tensors(**changes: Any) -> dict[str, Any]:
    found: dict[str, Any] = {
        "features.weight": POLICY.feature_weight,
        "features.bias": POLICY.feature_bias,
        **files.layer_tensors(POLICY.layers),
        **changes,
    }
    return {name: value for name, value in found.items() if value is not None}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is not safetensors"),
        (b"\xff" * 64, "is not safetensors"),
        (save({}), "missing or unknown"),
        (save(tensors(**{"layers.1.bias": None})), "['layers.1.bias'] are missing or unknown"),
        (save(tensors(**{"layers.0.bias": None, "layers.7.bias": np.ones(2, np.float32)})),
         "missing or unknown"),
        (save(tensors(**{"features.x": np.ones(2, np.float32)})), "['features.x'] are missing or"),
        (save(tensors(x=np.ones(2, np.float32))), "'x'] are missing or unknown"),
        (save(tensors(**{"layers.1.bias": np.ones(8)})), "layers.1.bias is F64, not F32"),
        (save(tensors(**{"layers.1.bias": np.ones(8, np.int8)})), "is I8, not F32"),
        (save(tensors(**{"layers.1.bias": np.ones(9, np.float32)})), "layers[1] bias must have"),
        (save(tensors(**{"layers.1.bias": np.full(8, np.nan, np.float32)})), "not finite"),
        (save(tensors(**{"features.weight": np.ones((0, 48), np.float32)})), "1 to 4096 outputs"),
    ],
)  # fmt: skip
def test_weights_that_are_something_else_are_refused(
    content: bytes, reason: str, file: Path
) -> None:
    put_weights(file, content)
    assert reason in refusal(file)


def test_weights_are_parsed_only_if_they_are_those_that_were_written(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[bytes] = []
    monkeypatch.setattr(files.safetensors, "deserialize", parsed.append)
    beside = file.with_suffix(".safetensors")
    content = bytearray(beside.read_bytes())
    content[-1] ^= 1
    beside.write_bytes(content)
    refusal(file)
    assert parsed == []


def test_a_file_too_large_is_not_read(file: Path) -> None:
    beside = file.with_suffix(".safetensors")
    os.truncate(beside, 2**36)  # sparse: it takes no room, unless it is read
    assert "68719476736 bytes, at most 67108864 are allowed" in refusal(file)
    os.truncate(file, 2**36)
    assert "at most 1048576 are allowed" in refusal(file)


def test_pipes_and_folders_are_not_waited_for(file: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    assert "not a plain file" in refusal(tmp_path / "folder.json")
    if hasattr(os, "mkfifo"):
        file.with_suffix(".safetensors").unlink()
        os.mkfifo(file.with_suffix(".safetensors"))
        assert "not a plain file" in refusal(file)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("none.json", "there is no file"),
        ("mine.safetensors", "give its spec"),
        ("model.zip", "lpv-track import-policy"),
        ("model.pt", "is no policy file: give the NAME.json"),
    ],
)
def test_what_to_give_instead(name: str, reason: str, file: Path) -> None:
    said = refusal(file.with_name(name))
    assert reason in said
    assert ("--trust" in said) == name.endswith(".zip")


def test_another_versions_entries_are_named(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scalars = (*observation.SCALARS[:-1], ("reference_speed", "km/h", 100.0))
    monkeypatch.setattr(observation, "SCALARS", scalars)
    monkeypatch.setattr(policies, "SCALARS", scalars)
    said = refusal(file)
    assert "['reference_speed', 'm/s'] then, ['reference_speed', 'km/h'] now): retrain it" in said
