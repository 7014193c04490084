"""Files of weight policies that were torn, changed, forged or poisoned: refused in one line."""

import json
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agents.weight_tuning.policy import load, read
from tests.helpers.learned_policies import change, put_weights
from tests.helpers.weight_policies import checked, random_weight_policy, refusal, same, written

POLICY = random_weight_policy()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return written(tmp_path, POLICY)


# Files that were changed.


@pytest.fixture(scope="module")
def whole() -> tuple[bytes, bytes]:
    """The two files of a policy with a catalogue."""
    with tempfile.TemporaryDirectory() as folder:
        file = written(Path(folder), random_weight_policy(catalogue=True))
        return file.read_bytes(), file.with_suffix(".safetensors").read_bytes()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to put such files in, again and again."""
    return tmp_path_factory.mktemp("weights")


def put(folder: Path, spec: bytes, weights: bytes) -> Path:
    file = folder / "mine.json"
    file.write_bytes(spec)
    file.with_suffix(".safetensors").write_bytes(weights)
    return file


@given(part=st.sampled_from([0, 1]), share=st.floats(0.0, 1.0, exclude_max=True))
@settings(max_examples=150, deadline=None)
def test_a_torn_file_is_refused_wherever_it_ends(
    whole: tuple[bytes, bytes], scratch: Path, part: int, share: float
) -> None:
    torn = list(whole)
    torn[part] = whole[part][: int(share * len(whole[part]))]
    file = put(scratch, *torn)
    if torn[part].strip() == whole[part].strip():
        read(file)  # the newline at the end of the spec
    else:
        refusal(file)
        refusal(file, load)


@given(
    part=st.sampled_from([0, 1]), share=st.floats(0.0, 1.0, exclude_max=True),
    flip=st.integers(1, 255),
)  # fmt: skip
@settings(max_examples=300, deadline=None)
@example(part=0, share=0.0, flip=0x80)
def test_a_changed_byte_is_refused_or_changes_nothing(
    whole: tuple[bytes, bytes], scratch: Path, part: int, share: float, flip: int
) -> None:
    changed = list(whole)
    at = int(share * len(whole[part]))
    content = bytearray(whole[part])
    content[at] ^= flip
    changed[part] = bytes(content)
    file = put(scratch, *changed)
    try:
        policy = read(file)
    except ValueError as error:
        checked(file, error)
        return
    # White space between the spec's tokens is nobody's, and some last digits round to one number.
    assert part == 0
    assert same(policy, random_weight_policy(catalogue=True))


def test_every_region_of_both_files_is_covered(whole: tuple[bytes, bytes], tmp_path: Path) -> None:
    for part in (0, 1):
        for start in range(0, len(whole[part].rstrip()), 64):
            changed = list(whole)
            region = whole[part][start : start + 64]
            swapped = bytes(byte if chr(byte).isspace() else byte ^ 1 for byte in region)
            changed[part] = whole[part][:start] + swapped + whole[part][start + 64 :]
            refusal(put(tmp_path, *changed))


def test_weights_of_another_policy_are_refused(file: Path, tmp_path: Path) -> None:
    other = written(tmp_path / "other", random_weight_policy(seed=1))
    shutil.copy(other.with_suffix(".safetensors"), file.with_suffix(".safetensors"))
    said = refusal(file)
    assert "mine.safetensors" in said
    assert "copy it anew" in said


@given(share=st.floats(0.0, 1.0, exclude_max=True), new=st.binary(min_size=1, max_size=4))
@settings(max_examples=200, deadline=None)
def test_weights_with_other_bytes_and_their_digest_are_refused_or_are_finite(
    whole: tuple[bytes, bytes], scratch: Path, share: float, new: bytes
) -> None:
    end = 8 + int.from_bytes(whole[1][:8], "little") + 400  # the header, and some of the numbers
    at = int(share * end)
    file = put(scratch, *whole)
    put_weights(file, whole[1][:at] + new + whole[1][at + len(new) :])
    try:
        policy = read(file)
    except ValueError as error:
        checked(file, error)
        return
    assert all(np.isfinite(array).all() for layer in policy.layers for array in layer)


# Any change of any place of a spec.


def places(value: Any, where: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a JSON value, but its whole."""
    inner: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        inner = list(value.items())
    elif isinstance(value, list):
        inner = list(enumerate(value))
    for key, found in inner:
        yield (*where, key)
        yield from places(found, (*where, key))


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
    scratch: Path, whole: tuple[bytes, bytes], data: st.DataObject, how: str, value: Any
) -> None:
    spec = json.loads(whole[0])
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
    file = put(scratch, json.dumps(spec).encode(), whole[1])
    change(file, put_right)
    try:
        policy = read(file)
    except ValueError as error:
        checked(file, error)
        return
    # It is read for what it says, all of it and nothing else.
    with tempfile.TemporaryDirectory() as folder:
        again = json.loads(written(Path(folder), policy).read_text())
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
        refusal(file)


# Pickles.


class Payload:
    """What a pickle runs when it is loaded: here it makes a folder."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.marker,)


def test_a_pickle_in_place_of_the_weights_is_not_run(file: Path, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    marker = tmp_path / "was-run"
    torch.save({"layers.0.weight": Payload(marker)}, tmp_path / "weights.pt")
    for content in ((tmp_path / "weights.pt").read_bytes(), pickle.dumps(Payload(marker))):
        put_weights(file, content)
        for by in (read, load):
            assert "is not safetensors" in refusal(file, by)
    assert not marker.exists()
    # The payload is real.
    torch.load(tmp_path / "weights.pt", weights_only=False)
    assert marker.is_dir()


def test_a_pickle_in_place_of_the_spec_is_not_run(file: Path, tmp_path: Path) -> None:
    marker = tmp_path / "was-run"
    for protocol in (0, 4):
        file.write_bytes(pickle.dumps(Payload(marker), protocol=protocol))
        for by in (read, load):
            refusal(file, by)
    assert not marker.exists()
    pickle.loads(file.read_bytes())  # noqa: S301
    assert marker.is_dir()


def test_reading_unpickles_nothing_and_loads_no_torch(file: Path) -> None:
    code = (
        "import sys\n"
        "from agents.weight_tuning.policy import load\n"
        "found = []\n"
        "sys.addaudithook(lambda event, _: found.append(event) if 'pickle' in event else None)\n"
        f"load({str(file)!r})\n"
        "print(found, sorted({'torch', 'stable_baselines3', 'casadi'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.split() == ["[]", "[]"], done.stderr
