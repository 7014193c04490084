"""Files of weight policies: what is read is what was written, or one line says why not."""

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from agents.learned import files as core
from agents.weight_tuning import policy as files
from agents.weight_tuning.choice import LONGEST_WINDOW, WeightChoice
from agents.weight_tuning.features import names
from agents.weight_tuning.policy import load, read, write
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import ObservationLayout
from tests.helpers.learned_policies import change, put_weights, random_policy
from tests.helpers.learned_policies import refusal as refusal_of_driving
from tests.helpers.learned_policies import written as written_driving
from tests.helpers.weight_policies import (
    random_weight_choice,
    random_weight_policy,
    random_weights,
    refusal,
    same,
    written,
)
from trajectories import CurvatureBands

POLICY = random_weight_policy()
BASE = random_weight_choice().schedule


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return written(tmp_path, POLICY)


# What is written is what is read.


@pytest.mark.parametrize("catalogue", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_round_trip_bit_for_bit(seed: int, catalogue: bool, tmp_path: Path) -> None:
    policy = random_weight_policy(seed, catalogue)
    file = written(tmp_path, policy)
    assert len(policy.choice.catalogue) == (5 if catalogue else 0)
    for found in (read(file), read(str(file)), load(file)):
        assert same(found, policy)
    assert sorted(found.name for found in tmp_path.iterdir()) == ["mine.json", "mine.safetensors"]


def test_extremes_survive(tmp_path: Path) -> None:
    bands = CurvatureBands((5e-324, 1e308), ("a\n", "\ud800", ""), hysteresis=0.0)
    sets = tuple(TrackingWeights(Q=(value, -0.0, 5e-324, 1e308)) for value in (0.0, 0.1 + 0.2, 1.0))
    choice = WeightChoice(
        WeightSchedule(bands, sets, 0.3, None, {"é": [[], {}, 10**400]}),
        span=float(np.nextafter(1.0, 2.0)), window=5e-324,
    )  # fmt: skip
    policy = random_weight_policy(
        choice=choice, hidden=(), layout=ObservationLayout(7, 0.1 + 0.2), control_period=1 / 30,
        algorithm="a\nb", training={},
    )  # fmt: skip
    assert same(read(written(tmp_path, policy)), policy)


def test_whole_numbers_and_other_types_of_numbers_survive(tmp_path: Path) -> None:
    base = WeightSchedule(
        CurvatureBands((1, 2), ("a", "b", "c"), 0), (TrackingWeights(),) * 3, 0, np.float64(4)
    )
    choice = WeightChoice(base, span=np.float32(2.0), window=1)
    policy = random_weight_policy(choice=choice, control_period=np.float64(1))
    found = read(written(tmp_path, policy))
    assert same(found, policy)
    assert (found.choice.schedule, found.choice.window, found.control_period) == (base, 1.0, 1.0)


def test_the_same_policy_is_the_same_bytes(tmp_path: Path) -> None:
    one, other = written(tmp_path / "a", POLICY), written(tmp_path / "b", random_weight_policy())
    for suffix in (".json", ".safetensors"):
        assert one.with_suffix(suffix).read_bytes() == other.with_suffix(suffix).read_bytes()


def test_a_policy_moves_with_its_two_files(file: Path, tmp_path: Path) -> None:
    shutil.copytree(file.parent, tmp_path / "elsewhere")
    assert same(read(tmp_path / "elsewhere" / file.name), POLICY)


def test_what_a_policy_holds_cannot_be_changed_from_outside() -> None:
    noted = {"seeds": [1]}
    schedule = dataclasses.replace(BASE, provenance=noted)
    policy = random_weight_policy(choice=WeightChoice(schedule), training=noted)
    noted["seeds"].append(2)
    assert policy.choice.schedule.provenance == policy.training == {"seeds": [1]}


def test_weights_are_there_before_a_spec_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    monkeypatch.setattr(core, "write_atomically", lambda file, _: order.append(file.suffix))
    write(POLICY, tmp_path / "mine.json")
    assert order == [".safetensors", ".json"]


@pytest.mark.parametrize("name", ["mine.safetensors", "mine", "mine.zip", "my:policy.json"])
def test_written_to_json_with_a_plain_name_only(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"{name}.* a weight policy"):
        write(POLICY, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_what_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    text = random_weight_policy(training={"note": "x" * 2**20})
    with pytest.raises(ValueError, match=r"at most 1048576 .*: make the weight policy smaller"):
        write(text, tmp_path / "mine.json")
    large = random_weight_policy(hidden=(4096, 4096))
    with pytest.raises(ValueError, match=r"at most 67108864 .*: make the weight policy smaller"):
        write(large, tmp_path / "mine.json")
    assert not list(tmp_path.iterdir())


# What makes no policy, or no choice.


LAYERS = POLICY.layers


def based(**changes: Any) -> dict[str, WeightChoice]:
    return {"choice": WeightChoice(dataclasses.replace(BASE, **changes))}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"algorithm": " "}, "algorithm must be a name"),
        ({"algorithm": 7}, "algorithm must be a name"),
        ({"control_period": "0.05"}, "control_period must be a number"),
        ({"control_period": None}, "control_period must be a number"),
        ({"control_period": 10**400}, "control_period must be finite"),
        ({"control_period": 0.0}, "control_period must be in"),
        ({"layers": ()}, "layers must be 1 to 16, not 0"),
        ({"layers": LAYERS[1:]}, r"layers\[0\] weight must have shape"),
        ({"layers": LAYERS[:1]}, "the last layer must have"),
        ({"layers": (LAYERS[0][0],)}, "must be a weight and a bias"),
        ({"training": [1]}, "training must be a mapping"),
        (based(slew=float("inf")), "choice.base must be plain JSON with finite numbers"),
        (based(provenance={"set": {1}}), "choice.base must be plain JSON"),
    ],
)
def test_what_is_no_policy_is_named(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as raised:
        random_weight_policy(**changes)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"span": "10"}, "span must be a number, not '10'"),
        ({"span": True}, "span must be a number"),
        ({"span": 1.0}, "span must be above 1"),
        ({"span": float("nan")}, "span must be finite"),
        ({"window": None}, "window must be a number"),
        ({"window": 0.0}, r"window must be in \(0, 1e\+09\] s"),
        ({"window": 1e300}, r"window must be in \(0, 1e\+09\] s"),
        ({"directions": {}}, "unknown directions {}"),
    ],
)
def test_what_is_no_choice_is_named(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as raised:
        WeightChoice(**changes)
    assert "\n" not in str(raised.value)


def test_the_longest_window_is_counted_in_64_bits() -> None:
    assert round(LONGEST_WINDOW / 0.001) < 2**63


# Files that are something else.


def of_choice(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda spec: spec["choice"].update(changes)


def of_base(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda spec: spec["choice"]["base"].update(changes)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda s: s.update(format="lpv-track-weights/2"),
         "this version reads 'lpv-track-weights/1': retrain or upgrade"),
        (lambda s: s.pop("format"), "format is None"),
        (lambda s: s.update(extra=1), "unknown key 'extra'"),
        (lambda s: s.pop("features"), "no key 'features': write the weight policy again"),
        (lambda s: s["choice"].pop("span"), "no key 'choice.span'"),
        (lambda s: s["choice"].update(more=1), "unknown key 'choice.more'"),
        (lambda s: s.update(choice=[]), "choice must be an object"),
        (lambda s: s.update(layout=None), "layout must be an object"),
        (lambda s: s.update(weights=3), "weights must be an object"),
        (lambda s: s["layout"].update(preview_steps=30), "made for an observation of other"),
        (lambda s: s.update(control_period="0.05"), "control_period must be a number"),
        (lambda s: s.update(control_period=10**400), "control_period must be finite"),
        (lambda s: s.update(algorithm=None), "algorithm must be a name"),
        (lambda s: s.update(training=[]), "training must be a mapping"),
        (lambda s: s.update(features="0" * 16), "made for other features than this version's"),
        (lambda s: s.update(features=None), "made for other features"),
        (of_choice(directions="some"), "choice: unknown directions 'some'; known: joint"),
        (of_choice(directions=["joint"]), "unknown directions"),
        (of_choice(span="10"), "choice: span must be a number"),
        (of_choice(span=True), "span must be a number"),
        (of_choice(span=1.0), "span must be above 1"),
        (of_choice(span=2), "choice.span is 2, not 2.0: write the weight policy again"),
        (of_choice(window=10**400), "window must be finite"),
        (of_choice(window=1e300), "window must be in"),
        (of_choice(catalogue=None), "choice.catalogue: 'NoneType'"),
        (of_choice(catalogue=[3]), "choice.catalogue: "),
        (of_choice(catalogue=[{"Q": [1, 2, 3]}]), "choice.catalogue: Q needs 4 weights"),
        (of_choice(catalogue=[{"P\n": 1}]), "choice.catalogue: "),
        (of_choice(catalogue=[{}] * 6), "outputs, as the choice has entries, not"),
        (of_choice(base=None), "choice.base: 'NoneType'"),
        (of_choice(base={}), "choice.base: format is None, not 'weight-schedule/2'"),
        (of_base(format="weight-schedule/1"),
         "choice.base.format is 'weight-schedule/1', not 'weight-schedule/2'"),
        (lambda s: s["choice"]["base"].pop("bands"), "choice.base: no 'bands' in it"),
        (lambda s: s["choice"]["base"].pop("slew"), "no key 'choice.base.slew'"),
        (of_base(more=1), "unknown key 'choice.base.more'"),
        (of_base(blend="0"), "choice.base.blend is '0', not 0.0"),
        (of_base(blend=False), "choice.base.blend is False, not 0.0"),
        (of_base(slew=-1.0), "choice.base: slew must be positive"),
        (of_base(weights=[]), "choice.base: 4 bands need as many sets"),
        (of_base(provenance=[["a", 1]]), "choice.base.provenance is [['a', 1]], not {'a': 1}"),
        (lambda s: s["choice"]["base"]["weights"][2].pop("Q"),
         "no key 'choice.base.weights[2].Q'"),
        (lambda s: s["choice"]["base"]["weights"][2].update(Q="1234"),
         "choice.base.weights[2].Q is '1234', not [1.0, 2.0, 3.0, 4.0]"),
        (lambda s: s["choice"]["base"]["weights"][1]["S"].__setitem__(3, -1.0),
         "choice.base: S must be finite and not negative"),
        (lambda s: s["choice"]["base"]["bands"].update(thresholds=[3.0, 2.0, 1.0]),
         "choice.base: thresholds must increase"),
        (lambda s: s["choice"]["base"]["bands"].update(hysteresis=1),
         "choice.base: hysteresis must be in"),
        (lambda s: s["weights"].update(file="../mine.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file="\ud800.safetensors"), "in the same folder"),
        (lambda s: s["weights"].update(file="mine-2.safetensors"), "there is no file"),
        (lambda s: s["weights"].update(bytes=7), "7 were written: copy it anew"),
        (lambda s: s["weights"].update(bytes="a\nb"), r"'a\nb' were written"),
        (lambda s: s["weights"].update(bytes=float(s["weights"]["bytes"])), ".0 were written"),
        (lambda s: s["weights"].update(sha256=None), "was changed since it was written"),
    ],
)  # fmt: skip
def test_a_spec_that_says_something_else_is_refused(
    edit: Callable[[dict[str, Any]], Any], reason: str, file: Path
) -> None:
    change(file, edit)
    assert reason in refusal(file)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "7", "[" * 100_000, '{"a": 1, "a": 2}', '{"a": NaN}', '{"a": ' + "9" * 5000 + "}"],
)
def test_what_is_no_json_object_is_refused(text: str, file: Path) -> None:
    file.write_text(text)
    assert "is not a weight policy's JSON" in refusal(file)
    refusal(file, load)


@pytest.mark.parametrize("key", ["span", "window", "training"])
@pytest.mark.parametrize("value", ["NaN", "-Infinity", "3e999"])
def test_what_is_no_finite_number_is_refused(key: str, value: str, file: Path) -> None:
    spec = json.loads(file.read_text())
    (spec if key == "training" else spec["choice"])[key] = "here"
    file.write_text(json.dumps(spec).replace('"here"', value))
    assert "is not a weight policy's JSON" in refusal(file)


def tensors(**changes: Any) -> dict[str, Any]:
    found: dict[str, Any] = {**core.layer_tensors(POLICY.layers), **changes}
    return {name: value for name, value in found.items() if value is not None}


def header(**tensors: Any) -> bytes:
    """Safetensors with no data, of such a header."""
    text = json.dumps(tensors).encode()
    return len(text).to_bytes(8, "little") + text


def empty(**changes: Any) -> bytes:
    """All tensors of the policy, empty, one of them otherwise."""
    plain = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    return header(**{**dict.fromkeys(tensors(), plain), "layers.0.bias": {**plain, **changes}})


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is not safetensors"),
        (b"\xff" * 64, "is not safetensors"),
        (empty(dtype="F\n32"), "is not safetensors"),
        (save({}), "missing or unknown"),
        (save(tensors(**{"layers.1.bias": None})), "['layers.1.bias'] are missing or unknown"),
        (save(tensors(**{"features.weight": np.ones((1, 1), np.float32)})), "missing or unknown"),
        (save(tensors(**{"layers.1.bias": np.ones(5)})), "layers.1.bias is F64, not F32"),
        (save(tensors(**{"layers.1.bias": np.ones(9, np.float32)})), "layers[1] bias must have"),
        (save(tensors(**{"layers.1.bias": np.full(5, np.nan, np.float32)})), "not finite"),
        (empty(), "layers[0] weight must have shape"),
        (empty(shape=[0, 2**63]), "layers.0.bias has shape [0, 9223372036854775808]"),
        (empty(shape=[0] * 99), "layers.0.bias has shape"),
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
    monkeypatch.setattr(core.safetensors, "deserialize", parsed.append)
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
    for by in (read, load):
        assert "at most 1048576 are allowed" in refusal(file, by)


def test_pipes_and_folders_are_not_waited_for(file: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    for by in (read, load):
        assert "not a plain file" in refusal(tmp_path / "folder.json", by)
    if hasattr(os, "mkfifo"):
        for name, found in (("mine.safetensors", file), ("pipe.json", tmp_path / "pipe.json")):
            (tmp_path / name).unlink(missing_ok=True)
            os.mkfifo(tmp_path / name)
            assert "not a plain file" in refusal(found)
        assert "not a plain file" in refusal(tmp_path / "pipe.json", load)


# Features of another version.


def test_other_scales_of_features_are_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "SCALES", files.SCALES * (1.0 + 2**-52))
    assert "made for other features than this version's (names or scales)" in refusal(file)


def test_other_names_of_features_are_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "names", lambda bands: ("speed", *names(bands)[1:]))
    assert "made for other features than this version's (names or scales)" in refusal(file)


# Kinds of files.


def test_a_schedule_is_loaded_as_one(tmp_path: Path) -> None:
    file = tmp_path / "schedule.json"
    for schedule in (BASE, dataclasses.replace(BASE, slew=float("inf"), provenance={"é": "\n"})):
        schedule.write(file)
        assert load(file) == load(str(file)) == schedule
    older = {**BASE.as_dict(), "format": "weight-schedule/1", "slew": None}
    file.write_text(json.dumps(older))
    assert load(file) == dataclasses.replace(BASE, slew=None)


def test_a_schedules_own_form_is_its_files(tmp_path: Path) -> None:
    BASE.write(tmp_path / "schedule.json")
    content = json.loads((tmp_path / "schedule.json").read_text())
    assert json.loads(json.dumps(BASE.as_dict())) == content
    assert WeightSchedule.from_dict(content) == WeightSchedule.from_dict(BASE.as_dict()) == BASE
    with pytest.raises(ValueError, match=r"^no 'bands' in it$"):
        WeightSchedule.from_dict({"format": content["format"]})


def test_a_schedule_that_cannot_be_read_is_named_as_one(tmp_path: Path) -> None:
    file = tmp_path / "schedule.json"
    file.write_text(json.dumps({**BASE.as_dict(), "blend": 7.0}))
    assert "weight schedule" in refusal(file, load)
    file.write_text(json.dumps({**BASE.as_dict(), "format": "weight-schedule/3"}))
    assert "format is 'weight-schedule/3', not 'weight-schedule/2'" in refusal(file, load)


def test_policies_are_not_mistaken_for_one_another(file: Path, tmp_path: Path) -> None:
    driving = written_driving(tmp_path, random_policy(), "driving.json")
    for by in (read, load):
        assert "driving.json is a policy that drives: --agent takes it" in refusal(driving, by)
    assert "mine.json is a policy of weights: " in refusal_of_driving(file)
    BASE.write(tmp_path / "schedule.json")
    for said in (
        refusal(tmp_path / "schedule.json"), refusal_of_driving(tmp_path / "schedule.json")
    ):  # fmt: skip
        assert "schedule.json is a schedule of weights: " in said


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"7", b"[]", b"{}", b"null", b"[" * 100_000, b"\xff\xfe", b"hello",
     b'{"format": 3}', b'{"format": "weight-schedule"}', b'{"format": "mine/1"}',
     b'{"format": ["weight-schedule/2"]}'],
    ids=lambda content: repr(content[:16]),
)  # fmt: skip
def test_what_is_neither_is_told_of_both(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_bytes(content)
    said = refusal(tmp_path / "mine.json", load)
    assert "is no weight schedule or weight policy: give the .json of a schedule" in said
    assert "(weight-schedule/2) or of a policy (lpv-track-weights/1)" in said


@pytest.mark.parametrize(
    ("by", "name", "reason"),
    [
        (read, "none.json", "there is no file"),
        (read, "mine.safetensors", "a weight policy's weights alone: give its spec"),
        (read, "model.zip", "is no weight policy file: give the NAME.json"),
        (load, "none.json", "give the path of a weight schedule or weight policy"),
        (load, "mine.safetensors", "a weight policy's weights alone: give its spec"),
        (load, "model.zip", "there is no file"),
    ],
)
def test_what_to_give_instead(
    by: Callable[[Path], object], name: str, reason: str, file: Path
) -> None:
    assert reason in refusal(file.with_name(name), by)


def test_random_policies_differ_by_their_seed() -> None:
    assert not same(random_weight_policy(1), random_weight_policy(2))
    assert random_weights(np.random.default_rng(1)) != random_weights(np.random.default_rng(2))
