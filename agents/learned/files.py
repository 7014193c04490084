"""Read files of policies: NAME.json describes one, a .safetensors beside it has its numbers.

`storage` writes them. This is the common core; `Kind` says how the files of one kind of policy
differ. Reading executes nothing: the files hold JSON and plain numbers, nothing is unpickled.
NAME.json contains a digest of itself and one of the weights, so damaged or edited files are
refused. The digests find accidents.
They do not keep anybody from writing another policy, but the worst it can do is to drive badly.

A file that cannot be used is a ValueError of one line that names the file and says what to do.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.fileio import checked, parse_json, read_bytes

MOST_WEIGHTS = 64 * 2**20
"""Largest .safetensors that is written or read, bytes."""
MOST_SPEC = 2**20
"""Largest .json that is written or read, bytes."""
MOST_LAYERS = 16
"""Largest number of layers of a network."""

COMMON_KEYS = frozenset(
    ("format", "control_period", "layout", "algorithm", "weights", "training", "digest")
)
OBJECTS: Mapping[str, frozenset[str]] = {
    "weights": frozenset(("file", "sha256", "bytes")),
    "layout": frozenset(("preview_steps", "preview_period", "digest", "entries")),
}
"""Keys of the objects that every spec has."""

FAMILIES: Mapping[str, str] = {
    "lpv-track-policy": "is a policy that drives: --agent takes it",
    "lpv-track-weights": "is a policy of weights: agent lpv-nmpc-tuned drives with it",
    "weight-schedule": "is a schedule of weights: the NMPC's agents take it as weights",
}
"""Format without its version -> hint for a user who gave such a file where another is wanted."""

BESIDE = re.compile(r"[^/\\:\x00-\x1f\x7f\ud800-\udfff]+\.safetensors")
"""Allowed names of a weights file: in the folder of its spec, on every operating system."""

DIGEST = re.compile(r"\.[0-9a-f]{16}$")
"""End of a weights file's name without its suffix, see `storage`."""

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Weight (outputs, inputs) and bias (outputs,)."""
Spec = dict[str, Any]
"""Content of a NAME.json."""
Tensors = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Kind:
    """Kind of policy file.

    Parameters
    ----------
    format
        Name and version, FAMILY/N.
    noun
        Name of such a policy in messages.
    keys
        Keys of its spec besides `COMMON_KEYS`.
    objects
        Key -> keys of the objects in its spec besides `OBJECTS`.
    stages
        Names of the linear stages in front of the layers in the weights file.
    optional
        Keys that a spec may have, too.
    """

    format: str
    noun: str
    keys: frozenset[str]
    objects: Mapping[str, frozenset[str]] = field(default_factory=dict)
    stages: tuple[str, ...] = ()
    optional: frozenset[str] = frozenset()


def check_suffix(kind: Kind, file: Path) -> None:
    """Check that a file is a NAME.json; the error says which file to give instead."""
    if file.suffix == ".json":
        return
    name = shortened(file)
    if file.suffix == ".safetensors":
        spec = file.with_name(f"{DIGEST.sub('', file.stem)}.json")
        raise ValueError(f"{name} holds a {kind.noun}'s weights alone: give its spec, {spec}")
    raise ValueError(f"{name} is no {kind.noun} file: give the NAME.json that it was written to")


def read_spec(kind: Kind, file: Path) -> Spec:
    """Read a spec, checking its format, its keys and its digest.

    No key is missing or unknown, at the top and in the objects of `OBJECTS` and `kind.objects`;
    the values are not checked.
    """
    check_suffix(kind, file)
    name = f"{kind.noun} {file}"
    spec = checked(parse_json(_content(file, MOST_SPEC, kind.noun), name), dict[str, Any], name)
    form = spec.get("format")
    if form != kind.format:
        if family(form) in FAMILIES.keys() - {family(kind.format)}:
            raise ValueError(f"{file} {FAMILIES[family(form)]}")
        raise ValueError(
            f"{file}: format is {shown(form)}, this version reads {kind.format!r}: "
            "retrain or upgrade"
        )
    _check_keys(kind, file, "", spec, kind.keys | COMMON_KEYS, kind.optional)
    for name, keys in {**kind.objects, **OBJECTS}.items():
        _check_keys(kind, file, f"{name}.", spec[name], keys)
    if spec["digest"] != digest_of(spec):
        raise ValueError(
            f"{file} was changed since it was written: copy it anew, or write the {kind.noun} again"
        )
    return spec


def read_tensors(kind: Kind, file: Path, spec: Spec) -> Tensors:
    """Read the tensors of a spec's weights file after checking its size and digest.

    They are the weights and biases, float32, of `kind.stages` and of 1 to `MOST_LAYERS` layers,
    named as by `layer_tensors`. The shapes are not checked.
    """
    again = f"write the {kind.noun} again"
    name, size = spec["weights"]["file"], spec["weights"]["bytes"]
    if not isinstance(name, str) or not BESIDE.fullmatch(name):
        raise ValueError(
            f"{file}: weights.file is {shown(name)}, not a .safetensors in the same folder: {again}"
        )
    beside = file.parent / name
    content = _content(beside, MOST_WEIGHTS, kind.noun)
    if type(size) is not int or len(content) != size:
        raise ValueError(
            f"{beside} has {len(content)} bytes, {shown(size)} were written: copy it anew"
        )
    if hashlib.sha256(content).hexdigest() != spec["weights"]["sha256"]:
        raise ValueError(
            f"{beside} was changed since it was written: copy it anew, together with {file.name}"
        )
    try:
        found = dict(safetensors.deserialize(content))  # type: ignore[no-untyped-call]
    except safetensors.SafetensorError as error:
        reason = " ".join(str(error).split())  # it quotes the header, line breaks included
        raise ValueError(f"{beside} is not safetensors: {reason}: {again}") from error
    layers = len({name.rpartition(".")[0] for name in found} - set(kind.stages))
    stages = [*kind.stages, *(f"layers.{k}" for k in range(min(max(layers, 1), MOST_LAYERS)))]
    names = {f"{stage}.{part}" for stage in stages for part in ("weight", "bias")}
    if names != found.keys():
        raise ValueError(
            f"{beside}: tensors {shown(sorted(names ^ found.keys()))} are missing or unknown: "
            f"{again}"
        )
    for tensor, value in found.items():
        if value["dtype"] != "F32":
            raise ValueError(f"{beside}: {tensor} is {value['dtype']}, not F32: {again}")
    tensors: Tensors = {}
    for tensor, value in found.items():
        try:
            array = np.frombuffer(value["data"], dtype="<f4").reshape(value["shape"])
        except (ValueError, OverflowError) as error:  # empty, with more rows than numpy can count
            raise ValueError(
                f"{beside}: {tensor} has shape {shown(value['shape'])}: {again}"
            ) from error
        tensors[tensor] = array
    return tensors


def read_files(kind: Kind, file: Path) -> tuple[Spec, Tensors]:
    """Read a policy's spec and its tensors, see `read_spec` and `read_tensors`.

    A writer may replace both in between: then they are read again.
    """
    while True:
        before = _identity(file)
        spec = read_spec(kind, file)
        try:
            return spec, read_tensors(kind, file, spec)
        except ValueError:
            if _identity(file) == before:
                raise


def _identity(file: Path) -> tuple[int, ...]:
    """Return numbers that change whenever a file is replaced; () if there is none."""
    try:
        status = file.stat()
    except (OSError, ValueError):
        return ()
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


def layer_tensors(layers: tuple[Layer, ...]) -> Tensors:
    """Name the weights and biases of layers as in a weights file."""
    return {
        f"layers.{k}.{part}": array
        for k, layer in enumerate(layers)
        for part, array in zip(("weight", "bias"), layer, strict=True)
    }


def layers_of(tensors: Tensors) -> tuple[Layer, ...]:
    """Collect the layers from tensors: the inverse of `layer_tensors`, ignoring other stages."""
    count = sum(name.startswith("layers.") for name in tensors) // 2
    return tuple((tensors[f"layers.{k}.weight"], tensors[f"layers.{k}.bias"]) for k in range(count))


def format_of(file: Path, noun: str) -> object:
    """Return the "format" in a JSON file; None if it has none or is not JSON.

    `noun` says in the error for a file that cannot be read what kind of file was wanted.
    """
    content = _content(file, MOST_SPEC, noun)
    try:
        found = parse_json(content, file, infinite=True)
    except ValueError:
        return None
    return found.get("format") if isinstance(found, dict) else None


def family(form: object) -> str:
    """Return a format without its version; "" if it is not a format."""
    return form.rpartition("/")[0] if isinstance(form, str) else ""


def canonical(value: object) -> str:
    """Encode plain JSON independently of white space and the order of keys."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest_of(spec: Spec) -> str:
    """Return the SHA-256 of a spec without its "digest"."""
    rest = {key: value for key, value in spec.items() if key != "digest"}
    return hashlib.sha256(canonical(rest).encode()).hexdigest()


def _content(file: Path, most: int, noun: str) -> bytes:
    """Read a regular file of at most `most` bytes."""
    try:
        return read_bytes(file, most)
    except ValueError as error:
        raise ValueError(
            f"{error}: give the path of a {noun}, its .safetensors beside it"
        ) from None


def _check_keys(
    kind: Kind, file: Path, where: str, found: Any, known: frozenset[str],
    optional: frozenset[str] = frozenset(),
) -> None:  # fmt: skip
    """Check that an object has exactly the known keys, and perhaps optional ones."""
    again = f"write the {kind.noun} again"
    if not isinstance(found, dict):
        raise ValueError(f"{file}: {where.rstrip('.')} must be an object: {again}")  # noqa: TRY004
    for what, keys in (("unknown", found.keys() - known - optional), ("no", known - found.keys())):
        if keys:
            raise ValueError(
                f"{file}: {what} key {shown(where + min(keys))}: {again} with this version"
            )


def plain_json(name: str, value: object) -> dict[str, Any]:
    """Copy a mapping through JSON: tuples become lists, keys become strings.

    Anything that JSON does not have is a ValueError that begins with `name`.
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping, not {type(value).__name__}")  # noqa: TRY004
    try:
        text = json.dumps(dict(value), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{name} must be plain JSON with finite numbers: {error}") from error
    found: dict[str, Any] = parse_json(text, name)
    return found
