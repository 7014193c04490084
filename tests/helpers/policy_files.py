"""The two kinds of policy file for the tests of their common format, and ways to spoil a file."""

import hashlib
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from agents.learned import policy as driving
from agents.learned.policy import Kind, layer_tensors
from agents.weight_tuning import policy as weights
from tests.helpers import learned_policies, weight_policies

Files = tuple[bytes, bytes]
"""Contents of a .json and of its .safetensors."""
WEIGHTS_NAME = re.compile(r'"file": "(mine[^"/\\]*\.safetensors)"')


@dataclass(frozen=True)
class PolicyKind:
    """A kind of policy, and its functions."""

    kind: Kind
    make: Callable[..., Any]
    """Policy with random weights: `make(seed=0, hidden=(16, 8), **changes)`."""
    read: Callable[[Any], Any]
    write: Callable[[Any, Any], None]
    same: Callable[[Any, Any], bool]
    readers: tuple[Callable[[Any], Any], ...]
    """All functions that read such a file."""
    varied: dict[str, Any] = field(default_factory=dict)
    """Changes with which a policy has every part of a spec."""

    @property
    def noun(self) -> str:
        return self.kind.noun

    def written(self, folder: Path, policy: Any = None, name: str = "mine.json") -> Path:
        """Write a policy, by default `make()`."""
        file = folder / name
        self.write(self.make() if policy is None else policy, file)
        return file

    def whole(self) -> Files:
        """Contents of the two files of a small policy."""
        with tempfile.TemporaryDirectory() as folder:
            file = self.written(Path(folder), self.small())
            return file.read_bytes(), beside(file).read_bytes()

    def small(self) -> Any:
        return self.make(hidden=(3,), **self.varied)

    def tensors(self, policy: Any, **changes: Any) -> dict[str, Any]:
        """All tensors of a policy's file; None leaves one out."""
        features = {}
        if self.kind.stages:
            features = {
                "features.weight": policy.feature_weight, "features.bias": policy.feature_bias
            }  # fmt: skip
        found = {**features, **layer_tensors(policy.layers), **changes}
        return {name: value for name, value in found.items() if value is not None}


DRIVING = PolicyKind(
    driving.POLICY, learned_policies.random_policy, driving.read, driving.write,
    learned_policies.same, (driving.read,),
)  # fmt: skip
WEIGHTS = PolicyKind(
    weights.WEIGHT_POLICY, weight_policies.random_weight_policy, weights.read, weights.write,
    weight_policies.same, (weights.read, weights.load), {"catalogue": True},
)  # fmt: skip
KINDS = (DRIVING, WEIGHTS)
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.noun)


def refusal(file: Path, by: Callable[[Path], object]) -> str:
    """Message of a reader that refuses a file: one line that names the file."""
    with pytest.raises(ValueError, match=file.stem) as raised:
        by(file)
    return checked(file, raised.value)


def checked(file: Path, error: ValueError) -> str:
    """Message of an error, which must be one line that names the file."""
    said = str(error)
    assert len(said.splitlines()) == 1
    assert file.stem in said
    return said


def put(folder: Path, files: Files) -> Path:
    """Write the two files of a policy."""
    file = folder / "mine.json"
    file.write_bytes(files[0])
    named = WEIGHTS_NAME.search(files[0].decode(errors="replace"))
    (folder / (named[1] if named else "mine.safetensors")).write_bytes(files[1])
    return file


def beside(file: Path) -> Path:
    """The weights file of a spec."""
    return file.parent / json.loads(file.read_text())["weights"]["file"]


def change(file: Path, edit: Callable[[dict[str, Any]], Any], *, digest: bool = True) -> None:
    """Edit a spec, with the digest that then belongs to it."""
    spec = json.loads(file.read_text())
    edit(spec)
    if digest:
        spec.pop("digest", None)
        canonical = json.dumps(spec, sort_keys=True, separators=(",", ":"))
        spec["digest"] = hashlib.sha256(canonical.encode()).hexdigest()
    file.write_text(json.dumps(spec))


def put_weights(file: Path, content: bytes) -> None:
    """Replace the weights, with the digests that then belong to them."""
    beside(file).write_bytes(content)
    sha = hashlib.sha256(content).hexdigest()
    change(file, lambda spec: spec["weights"].update(sha256=sha, bytes=len(content)))


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


class Payload:
    """Object whose pickle makes a folder when it is loaded."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.marker,)
