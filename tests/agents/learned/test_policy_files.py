"""Files of policies of either kind: read as they were written, or refused in one line."""

import json
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

from agents.learned import files, storage
from agents.learned import policy as policies
from lpv_track_env import observation
from lpv_track_env.observation import ObservationLayout
from tests.helpers.policy_files import (
    DRIVING,
    KINDS,
    WEIGHTS,
    Files,
    PolicyKind,
    beside,
    change,
    checked,
    each_kind,
    put,
    put_weights,
    refusal,
)

POLICIES = {kind.noun: kind.make() for kind in KINDS}
WHOLE = {kind.noun: kind.whole() for kind in KINDS}


@pytest.fixture
def file(kind: PolicyKind, tmp_path: Path) -> Path:
    return kind.written(tmp_path, POLICIES[kind.noun])


# What is written is what is read.


@pytest.mark.parametrize("origin", ["zero", "actuators", "lpv-nmpc"])
@pytest.mark.parametrize(("activation", "squash"), [("tanh", "clip"), ("relu", "tanh")])
def test_round_trip_bit_for_bit(origin: str, activation: str, squash: str, tmp_path: Path) -> None:
    policy = DRIVING.make(
        origin=origin, activation=activation, squash=squash, hidden=(5, 1, 300),
        symmetric=origin == "zero",
        layout=ObservationLayout(7, 0.1 + 0.2), control_period=1 / 30, feature_limit=1e30,
        centre=np.array([5e-324, -0.0]), half=np.array([0.0, 1 / 3]),
    )  # fmt: skip
    file = DRIVING.written(tmp_path, policy)
    assert DRIVING.same(DRIVING.read(file), policy)
    assert DRIVING.same(DRIVING.read(str(file)), policy)
    assert not list(tmp_path.glob(".*"))


@each_kind
def test_the_same_policy_is_the_same_bytes(kind: PolicyKind, tmp_path: Path) -> None:
    one, other = kind.written(tmp_path / "a"), kind.written(tmp_path / "b")
    assert one.read_bytes() == other.read_bytes()
    assert beside(one).read_bytes() == beside(other).read_bytes()
    assert beside(one).name == beside(other).name


@each_kind
def test_a_policy_moves_with_its_two_files(kind: PolicyKind, file: Path, tmp_path: Path) -> None:
    shutil.copytree(file.parent, tmp_path / "elsewhere")
    assert kind.same(kind.read(tmp_path / "elsewhere" / file.name), POLICIES[kind.noun])


def test_what_a_policy_holds_cannot_be_changed_from_outside() -> None:
    weight, training = np.ones((12, 48), dtype=np.float32), {"seed": [1]}
    policy = DRIVING.make(feature_weight=weight, training=training)
    weight[:] = 2.0
    training["seed"].append(2)
    assert (policy.feature_weight == 1.0).all()
    assert policy.training == {"seed": [1]}
    with pytest.raises(ValueError, match="read-only"):
        policy.feature_weight[0, 0] = 3.0


@each_kind
def test_weights_are_there_before_a_spec_names_them(
    kind: PolicyKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    monkeypatch.setattr(storage, "write_atomically", lambda file, _: order.append(file.suffix))
    kind.written(tmp_path)
    assert order == [".safetensors", ".json"]


@each_kind
@pytest.mark.parametrize("name", ["mine.safetensors", "mine", "mine.zip", "my:policy.json"])
def test_written_to_json_with_a_plain_name_only(
    kind: PolicyKind, name: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=rf"{name}.* a {kind.noun}"):
        kind.written(tmp_path, name=name)
    assert not list(tmp_path.iterdir())


@each_kind
def test_what_could_not_be_read_is_not_written(kind: PolicyKind, tmp_path: Path) -> None:
    text = kind.make(training={"note": "x" * 2**20})
    smaller = f"are allowed: make the {kind.noun} smaller"
    with pytest.raises(ValueError, match=f"at most 1048576 {smaller}"):
        kind.written(tmp_path, text)
    large = kind.make(hidden=(4096, 4096))
    with pytest.raises(ValueError, match=f"at most 67108864 {smaller}"):
        kind.written(tmp_path, large)
    assert not list(tmp_path.iterdir())


# What makes no policy.


LAYERS = POLICIES["policy"].layers


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"algorithm": ""}, "algorithm must be a name"),
        ({"control_period": 0.0}, "control_period must be in"),
        ({"control_period": "0.05"}, "control_period must be a finite number"),
        ({"feature_limit": 0.0}, "feature_limit must be positive"),
        ({"feature_limit": np.inf}, "feature_limit must be a finite number"),
        ({"feature_limit": 10**400}, "feature_limit must be a finite number"),
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
        DRIVING.make(**changes)
    assert "\n" not in str(raised.value)


# Files that were changed.


def refused_by_all(kind: PolicyKind, file: Path) -> None:
    for by in kind.readers:
        refusal(file, by)


def changed(whole: Files, part: int, content: bytes) -> Files:
    return (content, whole[1]) if part == 0 else (whole[0], content)


@each_kind
@given(part=st.sampled_from([0, 1]), share=st.floats(0.0, 1.0, exclude_max=True))
@settings(max_examples=150, deadline=None)
def test_a_torn_file_is_refused_wherever_it_ends(kind: PolicyKind, part: int, share: float) -> None:
    whole = WHOLE[kind.noun]
    torn = whole[part][: int(share * len(whole[part]))]
    with tempfile.TemporaryDirectory() as folder:
        file = put(Path(folder), changed(whole, part, torn))
        if torn.strip() == whole[part].strip():
            kind.read(file)  # the newline at the end of the spec
        else:
            refused_by_all(kind, file)


@each_kind
@given(
    part=st.sampled_from([0, 1]), share=st.floats(0.0, 1.0, exclude_max=True),
    flip=st.integers(1, 255),
)  # fmt: skip
@settings(max_examples=300, deadline=None)
@example(part=0, share=0.0, flip=0x80)
def test_a_changed_byte_is_refused_or_changes_nothing(
    kind: PolicyKind, part: int, share: float, flip: int
) -> None:
    whole = WHOLE[kind.noun]
    at = int(share * len(whole[part]))
    content = bytearray(whole[part])
    content[at] ^= flip
    with tempfile.TemporaryDirectory() as folder:
        file = put(Path(folder), changed(whole, part, bytes(content)))
        try:
            policy = kind.read(file)
        except ValueError as error:
            checked(file, error)
            return
    # White space between the spec's tokens is not covered, and some last digits round to one
    # number.
    assert part == 0
    assert kind is WEIGHTS or bytes([whole[0][at]]).isspace()
    assert kind.same(policy, kind.small())


@each_kind
def test_every_region_of_both_files_is_covered(kind: PolicyKind, tmp_path: Path) -> None:
    whole = WHOLE[kind.noun]
    for part in (0, 1):
        for start in range(0, len(whole[part].rstrip()), 64):
            region = whole[part][start : start + 64]
            swapped = bytes(byte if chr(byte).isspace() else byte ^ 1 for byte in region)
            content = whole[part][:start] + swapped + whole[part][start + 64 :]
            refusal(put(tmp_path, changed(whole, part, content)), kind.read)


@each_kind
def test_training_text_is_covered_too(kind: PolicyKind, file: Path) -> None:
    change(file, lambda spec: spec["training"].update(seed=4), digest=False)
    assert "was changed since it was written: copy it anew" in refusal(file, kind.read)


@each_kind
def test_weights_of_another_policy_are_refused(
    kind: PolicyKind, file: Path, tmp_path: Path
) -> None:
    layers = tuple((weight + 1.0, bias) for weight, bias in POLICIES[kind.noun].layers)
    other = kind.written(tmp_path / "other", kind.make(layers=layers))
    shutil.copy(beside(other), beside(file))
    said = refusal(file, kind.read)
    assert f"{beside(file).name} was changed since it was written" in said
    assert "copy it anew, together with mine.json" in said


@each_kind
@given(share=st.floats(0.0, 1.0, exclude_max=True), new=st.binary(min_size=1, max_size=4))
@settings(max_examples=200, deadline=None)
def test_weights_with_other_bytes_and_their_digest_are_refused_or_are_finite(
    kind: PolicyKind, share: float, new: bytes
) -> None:
    whole = WHOLE[kind.noun]
    end = 8 + int.from_bytes(whole[1][:8], "little") + 400  # the header, and some of the numbers
    at = int(share * end)
    with tempfile.TemporaryDirectory() as folder:
        file = put(Path(folder), whole)
        put_weights(file, whole[1][:at] + new + whole[1][at + len(new) :])
        try:
            policy = kind.read(file)
        except ValueError as error:
            checked(file, error)
            return
    assert all(np.isfinite(array).all() for layer in policy.layers for array in layer)


# Files that are something else.


@each_kind
@pytest.mark.parametrize("version", ["2", "0"])
def test_another_version_is_refused(kind: PolicyKind, version: str, file: Path) -> None:
    family, _, now = kind.kind.format.rpartition("/")
    change(file, lambda s: s.update(format=f"{family}/{version}"))
    wanted = f"format is '{family}/{version}', this version reads '{family}/{now}': retrain or"
    assert wanted in refusal(file, kind.read)


@each_kind
@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda s: s.pop("format"), "format is None"),
        (lambda s: s.update(extra=1), "unknown key 'extra'"),
        (lambda s: s.update({"x" * 999 + "\n": 1}), "unknown key 'xxx"),
        (lambda s: s.pop("algorithm"), "no key 'algorithm': write the {noun} again"),
        (lambda s: s.pop("training"), "no key 'training'"),
        (lambda s: s["layout"].pop("entries"), "no key 'layout.entries'"),
        (lambda s: s["weights"].update(url="x"), "unknown key 'weights.url'"),
        (lambda s: s.update(weights=[]), "weights must be an object"),
        (lambda s: s.update(weights=3), "weights must be an object"),
        (lambda s: s.update(layout=None), "layout must be an object"),
        (lambda s: s.update(control_period="0.05"), "control_period must be a finite number"),
        (lambda s: s.update(control_period=10**400), "is beyond 64 bits"),
        (lambda s: s.update(algorithm=None), "algorithm must be a name"),
        (lambda s: s.update(training=[]), "training must be a mapping"),
        (lambda s: s["layout"].update(preview_steps=0), "preview_steps must be a whole"),
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
        (lambda s: s["weights"].update(file="\ud800.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file=7), "weights.file is 7"),
        (lambda s: s["weights"].update(file="mine-2.safetensors"), "No such file"),
        (lambda s: s["weights"].update(file="mine" * 99 + ".safetensors"), "cannot be read"),
        (lambda s: s["weights"].update(bytes=7), "7 were written: copy it anew"),
        (lambda s: s["weights"].update(bytes="a\nb"), r"'a\nb' were written"),
        (lambda s: s["weights"].update(bytes=float(s["weights"]["bytes"])), ".0 were written"),
        (lambda s: s["weights"].update(sha256="0"), "was changed since it was written"),
        (lambda s: s["weights"].update(sha256=None), "was changed since it was written"),
    ],
)  # fmt: skip
def test_a_spec_that_says_something_else_is_refused(
    kind: PolicyKind, edit: Callable[[dict[str, Any]], Any], reason: str, file: Path
) -> None:
    change(file, edit)
    assert reason.format(noun=kind.noun) in refusal(file, kind.read)


@pytest.mark.parametrize("kind", [DRIVING])
@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda s: s.pop("half"), "no key 'half'"),
        (lambda s: s.update(activation="elu"), "unknown activation 'elu'"),
        (lambda s: s.update(activation={}), "unknown activation {}"),
        (lambda s: s.update(half=[0.1, -0.1]), "half must not be negative"),
        (lambda s: s.update(half=["1", "1"]), "half is not an array of numbers"),
        (lambda s: s.update(half=[10**400, 1]), "is beyond 64 bits"),
        (lambda s: s.update(centre=[[1.0], 1.0]), "centre is not an array of numbers"),
    ],
)
def test_a_driving_policys_spec_that_says_something_else_is_refused(
    kind: PolicyKind, edit: Callable[[dict[str, Any]], Any], reason: str, file: Path
) -> None:
    change(file, edit)
    assert reason in refusal(file, kind.read)


@each_kind
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", ""),
        ("[]", "Expected `object`, got `array`"),
        ("7", "Expected `object`, got `int`"),
        ("[" * 100_000, "nested too deeply"),
        ('{"a": 1, "a": 2}', "key 'a' twice"),
        ('{"a": NaN}', "NaN is no number"),
        ('{"a": ' + "9" * 5000 + "}", ""),
    ],
)
def test_what_is_no_json_object_is_refused(
    kind: PolicyKind, text: str, reason: str, file: Path
) -> None:
    file.write_text(text)
    said = refusal(file, kind.read)
    assert f"{kind.noun} {file}: " in said
    assert reason in said
    refused_by_all(kind, file)


@each_kind
@pytest.mark.parametrize("key", ["control_period", "training"])
@pytest.mark.parametrize("value", ["NaN", "-Infinity", "3e999"])
def test_what_is_no_finite_number_is_refused(
    kind: PolicyKind, key: str, value: str, file: Path
) -> None:
    spec = json.loads(file.read_text())
    spec[key] = "here"
    file.write_text(json.dumps(spec).replace('"here"', value))
    assert f"{kind.noun} {file}: is not JSON" in refusal(file, kind.read)


def header(**tensors: Any) -> bytes:
    """Safetensors with such a header and no data."""
    text = json.dumps(tensors).encode()
    return len(text).to_bytes(8, "little") + text


def empty(names: dict[str, Any], **changes: Any) -> bytes:
    """Tensors of such names, all of them empty, layers.0.bias with changes."""
    plain = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    return header(**{**dict.fromkeys(names, plain), "layers.0.bias": {**plain, **changes}})


@each_kind
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (lambda _: b"", "is not safetensors"),
        (lambda _: b"\xff" * 64, "is not safetensors"),
        (lambda t: empty(t(), dtype="F\n32"), "is not safetensors"),
        (lambda _: save({}), "missing or unknown"),
        (lambda t: save(t(**{"layers.1.bias": None})), "['layers.1.bias'] are missing or unknown"),
        (lambda t: save(t(**{"layers.0.bias": None, "layers.7.bias": np.ones(2, np.float32)})),
         "missing or unknown"),
        (lambda t: save(t(**{"features.x": np.ones(2, np.float32)})), "are missing or unknown"),
        (lambda t: save(t(x=np.ones(2, np.float32))), "'x'] are missing or unknown"),
        (lambda t: save(t(**{"layers.1.bias": np.ones(8)})), "layers.1.bias is F64, not F32"),
        (lambda t: save(t(**{"layers.1.bias": np.ones(8, np.int8)})), "is I8, not F32"),
        (lambda t: save(t(**{"layers.1.bias": np.ones(9, np.float32)})), "layers[1] bias must"),
        (lambda t: save(t(**{"layers.1.bias": np.full_like(t()["layers.1.bias"], np.nan)})),
         "not finite"),
        (lambda t: empty(t()), "weight must have shape"),
        (lambda t: empty(t(), shape=[0, 2**63]), "layers.0.bias has shape [0, 92233720368547758"),
        (lambda t: empty(t(), shape=[0] * 99), "layers.0.bias has shape"),
    ],
)  # fmt: skip
def test_weights_that_are_something_else_are_refused(
    kind: PolicyKind, content: Callable[[Any], bytes], reason: str, file: Path
) -> None:
    put_weights(file, content(lambda **changes: kind.tensors(POLICIES[kind.noun], **changes)))
    assert reason in refusal(file, kind.read)


@pytest.mark.parametrize(
    ("kind", "changes", "reason"),
    [
        (DRIVING, {"features.x": np.ones(2, np.float32)}, "['features.x'] are missing or"),
        (DRIVING, {"features.weight": np.ones((0, 48), np.float32)}, "1 to 4096 outputs"),
        (WEIGHTS, {"features.weight": np.ones((1, 1), np.float32)}, "missing or unknown"),
    ],
)
def test_stages_before_the_layers_are_the_kinds(
    kind: PolicyKind, changes: dict[str, Any], reason: str, file: Path
) -> None:
    put_weights(file, save(kind.tensors(POLICIES[kind.noun], **changes)))
    assert reason in refusal(file, kind.read)


@each_kind
def test_weights_are_parsed_only_if_they_are_those_that_were_written(
    kind: PolicyKind, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[bytes] = []
    monkeypatch.setattr(files.safetensors, "deserialize", parsed.append)
    content = bytearray(beside(file).read_bytes())
    content[-1] ^= 1
    beside(file).write_bytes(content)
    refusal(file, kind.read)
    assert parsed == []


@each_kind
def test_a_file_too_large_is_not_read(kind: PolicyKind, file: Path) -> None:
    os.truncate(beside(file), 2**36)  # sparse: it takes no room, unless it is read
    assert "68719476736 bytes are too many: at most 67108864 are read" in refusal(file, kind.read)
    os.truncate(file, 2**36)
    for by in kind.readers:
        assert "at most 1048576 are read" in refusal(file, by)


@each_kind
def test_pipes_and_folders_are_not_waited_for(kind: PolicyKind, file: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    for by in kind.readers:
        assert "Is a directory" in refusal(tmp_path / "folder.json", by)
    if hasattr(os, "mkfifo"):
        beside(file).unlink()
        os.mkfifo(beside(file))
        assert "no regular file" in refusal(file, kind.read)
        os.mkfifo(tmp_path / "pipe.json")
        for by in kind.readers:
            assert "no regular file" in refusal(tmp_path / "pipe.json", by)


@each_kind
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("none.json", "No such file"),
        ("mine.safetensors", "a {noun}'s weights alone: give its spec"),
        ("model.pt", "is no {noun} file: give the NAME.json"),
    ],
)
def test_what_to_give_instead(kind: PolicyKind, name: str, reason: str, file: Path) -> None:
    assert reason.format(noun=kind.noun) in refusal(file.with_name(name), kind.read)


def test_a_model_of_sb3_is_to_be_imported(tmp_path: Path) -> None:
    said = refusal(tmp_path / "model.zip", DRIVING.read)
    assert "lpv-track import-policy" in said
    assert "--trust" in said
    assert "is no weight policy file" in refusal(tmp_path / "model.zip", WEIGHTS.read)


@each_kind
def test_another_versions_entries_are_named(
    kind: PolicyKind, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scalars = (*observation.SCALARS[:-1], ("reference_speed", "km/h", 100.0))
    monkeypatch.setattr(observation, "SCALARS", scalars)
    monkeypatch.setattr(policies, "SCALARS", scalars)
    said = refusal(file, kind.read)
    assert "['reference_speed', 'm/s'] then, ['reference_speed', 'km/h'] now): retrain it" in said
