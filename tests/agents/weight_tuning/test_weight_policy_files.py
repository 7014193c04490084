"""What the files of weight policies have beyond the common format, and which kind a file is."""

import dataclasses
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.weight_tuning import policy as policies
from agents.weight_tuning.choice import LONGEST_WINDOW, WeightChoice
from agents.weight_tuning.features import names
from agents.weight_tuning.policy import load, read
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import ObservationLayout
from tests.helpers.policy_files import (
    DRIVING,
    WEIGHTS,
    beside,
    change,
    checked,
    places,
    put,
    refusal,
)
from tests.helpers.weight_policies import (
    random_weight_choice,
    random_weight_policy,
    random_weights,
    same,
)
from trajectories import CurvatureBands

POLICY = random_weight_policy()
BASE = random_weight_choice().schedule


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return WEIGHTS.written(tmp_path, POLICY)


# What is written is what is read.


@pytest.mark.parametrize("catalogue", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_round_trip_bit_for_bit(seed: int, catalogue: bool, tmp_path: Path) -> None:
    policy = random_weight_policy(seed, catalogue)
    file = WEIGHTS.written(tmp_path, policy)
    assert len(policy.choice.catalogue) == (5 if catalogue else 0)
    for found in (read(file), read(str(file)), load(file)):
        assert same(found, policy)
    file = tmp_path / "mine.json"
    assert set(tmp_path.iterdir()) == {file, beside(file)}


def test_extremes_survive(tmp_path: Path) -> None:
    bands = CurvatureBands((5e-324, 1e308), ("a\n", "\ud800", ""), hysteresis=0.0)
    sets = tuple(TrackingWeights(Q=(value, -0.0, 5e-324, 1e308)) for value in (0.0, 0.1 + 0.2, 1.0))
    choice = WeightChoice(
        WeightSchedule(bands, sets, 0.3, None, {"é": [[], {}, 2**62]}),
        span=float(np.nextafter(1.0, 2.0)), window=5e-324,
    )  # fmt: skip
    policy = random_weight_policy(
        choice=choice, hidden=(), layout=ObservationLayout(7, 0.1 + 0.2), control_period=1 / 30,
        algorithm="a\nb", training={},
    )  # fmt: skip
    assert same(read(WEIGHTS.written(tmp_path, policy)), policy)


def test_whole_numbers_and_other_types_of_numbers_survive(tmp_path: Path) -> None:
    base = WeightSchedule(
        CurvatureBands((1, 2), ("a", "b", "c"), 0), (TrackingWeights(),) * 3, 0, np.float64(4)
    )
    choice = WeightChoice(base, span=np.float32(2.0), window=1)
    policy = random_weight_policy(choice=choice, control_period=np.float64(1))
    found = read(WEIGHTS.written(tmp_path, policy))
    assert same(found, policy)
    assert (found.choice.schedule, found.choice.window, found.control_period) == (base, 1.0, 1.0)


def test_what_a_policy_holds_cannot_be_changed_from_outside() -> None:
    noted = {"seeds": [1]}
    schedule = dataclasses.replace(BASE, provenance=noted)
    policy = random_weight_policy(choice=WeightChoice(schedule), training=noted)
    noted["seeds"].append(2)
    assert policy.choice.schedule.provenance == policy.training == {"seeds": [1]}


# What makes no policy, or no choice.


LAYERS = POLICY.layers


def based(**changes: Any) -> dict[str, WeightChoice]:
    return {"choice": WeightChoice(dataclasses.replace(BASE, **changes))}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"algorithm": " "}, "algorithm must be a name"),
        ({"algorithm": 7}, "algorithm must be a name"),
        ({"control_period": "0.05"}, "control_period must be a finite number"),
        ({"control_period": None}, "control_period must be a finite number"),
        ({"control_period": 10**400}, "control_period must be a finite number"),
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
        ({"span": "10"}, "span must be a finite number, not '10'"),
        ({"span": True}, "span must be a finite number"),
        ({"span": 1.0}, "span must be above 1"),
        ({"span": float("nan")}, "span must be a finite number"),
        ({"window": None}, "window must be a finite number"),
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
        (lambda s: s.pop("features"), "no key 'features': write the weight policy again"),
        (lambda s: s["choice"].pop("span"), "no key 'choice.span'"),
        (lambda s: s["choice"].update(more=1), "unknown key 'choice.more'"),
        (lambda s: s.update(choice=[]), "choice must be an object"),
        (lambda s: s.update(features="0" * 16), "made for other features than this version's"),
        (lambda s: s.update(features=None), "made for other features"),
        (of_choice(directions="some"), "choice: unknown directions 'some'; known: joint"),
        (of_choice(directions=["joint"]), "unknown directions"),
        (of_choice(span="10"), "choice: span must be a finite number"),
        (of_choice(span=True), "span must be a finite number"),
        (of_choice(span=1.0), "span must be above 1"),
        (of_choice(span=2), "choice.span is 2, not 2.0: write the weight policy again"),
        (of_choice(window=10**400), "is beyond 64 bits"),
        (of_choice(window=1e300), "window must be in"),
        (of_choice(catalogue=None), "choice.catalogue: 'NoneType'"),
        (of_choice(catalogue=[3]), "choice.catalogue: "),
        (of_choice(catalogue=[{"Q": [1, 2, 3]}]), "choice.catalogue: Q must be 4 numbers"),
        (of_choice(catalogue=[{"P\n": 1}]), "choice.catalogue: "),
        (of_choice(catalogue=[{}] * 6), "outputs, as the choice has entries, not"),
        (of_choice(base=None), "choice.base: 'NoneType'"),
        (of_choice(base={}), "choice.base: format is None, not 'weight-schedule/3'"),
        (of_base(format="weight-schedule/1"),
         "choice.base.format is 'weight-schedule/1', not 'weight-schedule/3'"),
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
         "choice.base: Q must be 4 numbers, each >= 0 and finite, not '1234'"),
        (lambda s: s["choice"]["base"]["weights"][1]["S"].__setitem__(3, -1.0),
         "choice.base: S[3] must be >= 0 and finite"),
        (lambda s: s["choice"]["base"]["bands"].update(thresholds=[3.0, 2.0, 1.0]),
         "choice.base: thresholds must increase"),
        (lambda s: s["choice"]["base"]["bands"].update(hysteresis=1),
         "choice.base: hysteresis must be"),
    ],
)  # fmt: skip
def test_a_spec_that_says_something_else_is_refused(
    edit: Callable[[dict[str, Any]], Any], reason: str, file: Path
) -> None:
    change(file, edit)
    assert reason in refusal(file, read)


@pytest.mark.parametrize("key", ["span", "window"])
@pytest.mark.parametrize("value", ["NaN", "-Infinity", "3e999"])
def test_what_is_no_finite_number_is_refused(key: str, value: str, file: Path) -> None:
    spec = json.loads(file.read_text())
    spec["choice"][key] = "here"
    file.write_text(json.dumps(spec).replace('"here"', value))
    assert "is not JSON" in refusal(file, read)


# Features of another version.


def test_other_scales_of_features_are_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies, "SCALES", policies.SCALES * (1.0 + 2**-52))
    assert "made for other features than this version's (names or scales)" in refusal(file, read)


def test_other_names_of_features_are_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies, "names", lambda bands: ("speed", *names(bands)[1:]))
    assert "made for other features than this version's (names or scales)" in refusal(file, read)


# Kinds of files.


def test_a_schedule_is_loaded_as_one(tmp_path: Path) -> None:
    file = tmp_path / "schedule.json"
    for schedule in (BASE, dataclasses.replace(BASE, slew=float("inf"), provenance={"é": "\n"})):
        schedule.write(file)
        assert load(file) == load(str(file)) == schedule
    older = {**BASE.as_dict(), "format": "weight-schedule/1", "slew": None}
    file.write_text(json.dumps(older))
    assert load(file) == dataclasses.replace(BASE, slew=None)
    for one in older["weights"]:
        del one["R_rate"]
    file.write_text(json.dumps({**older, "format": "weight-schedule/2", "slew": 3.0}))
    sets = tuple(dataclasses.replace(one, R_rate=(0.0, 0.0)) for one in BASE.weights)
    assert load(file) == dataclasses.replace(BASE, slew=3.0, weights=sets)


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
    file.write_text(json.dumps({**BASE.as_dict(), "format": "weight-schedule/4"}))
    assert "format is 'weight-schedule/4', not 'weight-schedule/3'" in refusal(file, load)


def test_policies_are_not_mistaken_for_one_another(file: Path, tmp_path: Path) -> None:
    driving = DRIVING.written(tmp_path, name="driving.json")
    for by in (read, load):
        assert "driving.json is a policy that drives: --agent takes it" in refusal(driving, by)
    assert "mine.json is a policy of weights: " in refusal(file, DRIVING.read)
    BASE.write(tmp_path / "schedule.json")
    for by in (read, DRIVING.read):
        said = refusal(tmp_path / "schedule.json", by)
        assert "schedule.json is a schedule of weights: " in said


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"7", b"[]", b"{}", b"null", b"[" * 100_000, b"\xff\xfe", b"hello",
     b'{"format": 3}', b'{"format": "weight-schedule"}', b'{"format": "mine/1"}',
     b'{"format": ["weight-schedule/3"]}'],
    ids=lambda content: repr(content[:16]),
)  # fmt: skip
def test_what_is_neither_is_told_of_both(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_bytes(content)
    said = refusal(tmp_path / "mine.json", load)
    assert "is no weight schedule or weight policy: give the .json of a schedule" in said
    assert "(weight-schedule/3) or of a policy (lpv-track-weights/1)" in said


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("none.json", "give the path of a weight schedule or weight policy"),
        ("mine.safetensors", "a weight policy's weights alone: give its spec"),
        ("model.zip", "No such file"),
    ],
)
def test_what_to_give_instead(name: str, reason: str, file: Path) -> None:
    assert reason in refusal(file.with_name(name), load)


def test_random_policies_differ_by_their_seed() -> None:
    assert not same(random_weight_policy(1), random_weight_policy(2))
    assert random_weights(np.random.default_rng(1)) != random_weights(np.random.default_rng(2))


# Any change of any place of a spec.

WHOLE = WEIGHTS.whole()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to put such files in, again and again."""
    return tmp_path_factory.mktemp("weights")


def put_right(_: dict[str, Any]) -> None:
    """The edit that leaves all but the digest as it is."""


anything = st.one_of(
    st.sampled_from(
        [
            10**400, -(10**400), 2**63, 1e308, -1e308, 5e-324, -0.0, 0, 1, True, False, None, "",
            "1.0", "nan", "a\nb", "\x85", "\ud800", "\0", "x" * 10_000, [], {}, [[]], [0.0] * 4,
            [1.0] * 10_000, float("nan"), float("inf"),
        ]
    ),
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=5)
        | st.dictionaries(st.text(max_size=5), inner, max_size=5),
        max_leaves=8,
    ),
)  # fmt: skip


@given(data=st.data(), how=st.sampled_from(["set", "set", "delete", "add"]), value=anything)
@settings(max_examples=500, deadline=None)
def test_a_spec_with_anything_anywhere_is_refused_or_is_a_policy_of_its_own(
    scratch: Path, data: st.DataObject, how: str, value: Any
) -> None:
    spec = json.loads(WHOLE[0])
    del spec["digest"]
    *outer, key = data.draw(st.sampled_from(list(places(spec))))
    inner = spec
    for step in outer:
        inner = inner[step]
    if how == "set":
        inner[key] = value
    elif how == "delete":
        del inner[key]
    elif isinstance(inner, list):
        inner.insert(key, value)
    else:
        inner[data.draw(st.text(max_size=5))] = value
    file = put(scratch, (json.dumps(spec).encode(), WHOLE[1]))
    change(file, put_right)
    try:
        policy = read(file)
    except ValueError as error:
        checked(file, error)
        return
    # It is read for what it says, all of it and nothing else.
    with tempfile.TemporaryDirectory() as folder:
        again = json.loads(WEIGHTS.written(Path(folder), policy).read_text())
    assert again.pop("digest")
    assert json.dumps(again, sort_keys=True) == json.dumps(spec, sort_keys=True)


@pytest.mark.parametrize("key", ["directions", "span", "base", "catalogue", "algorithm"])
def test_nesting_is_refused_at_every_depth(key: str, file: Path) -> None:
    spec = json.loads(file.read_text())
    (spec if key in spec else spec["choice"])[key] = "here"
    text = json.dumps(spec)
    limit = sys.getrecursionlimit()
    for depth in [*range(2, 100, 7), *range(limit - 150, limit + 10)]:
        file.write_text(text.replace('"here"', "[" * depth + "]" * depth))
        sys.setrecursionlimit(10 * limit)  # for the digest that belongs to it
        try:
            change(file, put_right)
        finally:
            sys.setrecursionlimit(limit)
        refusal(file, read)
