"""A checked spec with a network beside it: NAME.json says what it is, NAME.safetensors has numbers.

What the files of every kind of policy share. Reading runs nothing that the files say: JSON and
plain numbers, nothing is unpickled. The spec has a digest of itself and one of the weights, so a
change in either is refused before it is used. (The digests find accidents. Who wants to can write
another policy; it cannot do more than drive badly.)
"""

import hashlib
import json
import re
import reprlib
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from numpy.typing import NDArray

from agents.learned.policy import MOST_LAYERS, Layer, parse_json

MOST_WEIGHTS = 64 * 2**20
MOST_SPEC = 2**20
"""Bytes; a larger file is neither written nor read."""

COMMON_KEYS = frozenset(("format", "weights", "training", "digest"))
WEIGHTS_KEYS = frozenset(("file", "sha256", "bytes"))

FAMILIES: Mapping[str, str] = {
    "lpv-track-policy": "is a policy that drives: --agent takes it",
    "lpv-track-weights": "is a policy of weights: agent lpv-nmpc-tuned drives with it",
    "weight-schedule": "is a schedule of weights: the NMPC's agents take it as weights",
}
"""What is said of a file of another kind than was wanted, by its format without the version."""

BESIDE = re.compile(r"[^/\\:\x00-\x1f\x7f\ud800-\udfff]+\.safetensors")
"""Names of weights: in the spec's own folder, on every system."""

SHORT = reprlib.Repr()
SHORT.maxstring = 80

Spec = dict[str, Any]
Tensors = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Kind:
    """A kind of such files.

    Parameters
    ----------
    format
        Name and version, FAMILY/N.
    noun
        What messages call it.
    keys
        Of its spec, besides `COMMON_KEYS`.
    objects
        Keys of the objects in its spec, by their own key; those of "weights" are known.
    """

    format: str
    noun: str
    keys: frozenset[str]
    objects: Mapping[str, frozenset[str]]


def encoded(
    kind: Kind, file: Path, spec: Spec, training: Mapping[str, Any], weights: bytes
) -> tuple[tuple[Path, bytes], tuple[Path, bytes]]:
    """What to write where, in this order: a spec never names weights that are not there.

    Parameters
    ----------
    kind
        What it is.
    file
        NAME.json.
    spec
        The kind's own keys, plain JSON.
    training
        Where it comes from, plain JSON.
    weights
        Content of NAME.safetensors.

    Raises
    ------
    ValueError
        If the file's name does not end in .json, or a content is too large to be read again.
    """
    if file.suffix != ".json":
        raise ValueError(f"{file}: a {kind.noun} is written to NAME.json, give it such a name")
    beside = file.with_suffix(".safetensors")
    if not BESIDE.fullmatch(beside.name):
        raise ValueError(
            f"{file.name!r} is no name for a {kind.noun}: leave out \\, : and the like"
        )
    whole: Spec = {
        "format": kind.format,
        **spec,
        "weights": {
            "file": beside.name, "sha256": hashlib.sha256(weights).hexdigest(),
            "bytes": len(weights),
        },
        "training": training,
    }  # fmt: skip
    text = json.dumps({**whole, "digest": _digest(whole)}, indent=2, allow_nan=False) + "\n"
    for content, most in ((weights, MOST_WEIGHTS), (text.encode(), MOST_SPEC)):
        if len(content) > most:
            raise ValueError(
                f"{file}: {_too_large(len(content), most)}: make the {kind.noun} smaller"
            )
    return (beside, weights), (file, text.encode())


def check_suffix(kind: Kind, file: Path) -> None:
    """Refuse a name that is not NAME.json, saying what to give instead.

    Raises
    ------
    ValueError
        For such a name.
    """
    if file.suffix == ".json":
        return
    if file.suffix == ".safetensors":
        raise ValueError(
            f"{file} holds a {kind.noun}'s weights alone: give its spec, "
            f"{file.with_suffix('.json')}"
        )
    raise ValueError(f"{file} is no {kind.noun} file: give the NAME.json that it was written to")


def read_spec(kind: Kind, file: Path) -> Spec:
    """Read a spec of this kind: every key there, none besides, unchanged since it was written.

    The values themselves are still anything that JSON has, but for `kind.objects` and "weights",
    which are objects with their keys.

    Raises
    ------
    ValueError
        In one line that names the file and what to do.
    """
    content = _content(file, MOST_SPEC, kind.noun)
    try:
        spec = parse_json(content.decode())
    except UnicodeDecodeError:
        raise ValueError(f"{file} is not JSON but binary: give a {kind.noun}'s NAME.json") from None
    except ValueError as error:
        raise ValueError(f"{file} is not a {kind.noun}'s JSON: {error}: copy it anew") from error
    form = spec.get("format")
    if form != kind.format:
        if family(form) in FAMILIES.keys() - {family(kind.format)}:
            raise ValueError(f"{file} {FAMILIES[family(form)]}")
        raise ValueError(
            f"{file}: format is {shown(form)}, this version reads {kind.format!r}: "
            "retrain or upgrade"
        )
    _check_keys(kind, file, "", spec, kind.keys | COMMON_KEYS)
    for name, keys in {**kind.objects, "weights": WEIGHTS_KEYS}.items():
        _check_keys(kind, file, f"{name}.", spec[name], keys)
    try:
        unchanged = spec["digest"] == _digest(spec)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not a {kind.noun}'s JSON: {error}: copy it anew") from error
    if not unchanged:
        raise ValueError(
            f"{file} was changed since it was written: copy it anew, or write the {kind.noun} again"
        )
    return spec


def read_tensors(kind: Kind, file: Path, spec: Spec, before: tuple[str, ...] = ()) -> Tensors:
    """Read the tensors that the spec of a file names, if they are the bytes that were written.

    They are the weight and bias, float32, of the stages `before` and of 1 to `MOST_LAYERS` layers,
    as `layer_tensors` names them. Whether their shapes fit together is not looked at.

    Raises
    ------
    ValueError
        In one line that names a file and what to do.
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
        reason = " ".join(str(error).split())  # it quotes the header as it stands
        raise ValueError(f"{beside} is not safetensors: {reason}: {again}") from error
    layers = len({name.rpartition(".")[0] for name in found} - set(before))
    stages = [*before, *(f"layers.{k}" for k in range(min(max(layers, 1), MOST_LAYERS)))]
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
        except (ValueError, OverflowError) as error:  # an empty one of more than numpy can count
            raise ValueError(
                f"{beside}: {tensor} has shape {shown(value['shape'])}: {again}"
            ) from error
        tensors[tensor] = array
    return tensors


def layer_tensors(layers: tuple[Layer, ...]) -> Tensors:
    """Name the weights and biases of layers, as files have them."""
    return {
        f"layers.{k}.{part}": array
        for k, layer in enumerate(layers)
        for part, array in zip(("weight", "bias"), layer, strict=True)
    }


def layers_of(tensors: Tensors) -> tuple[Layer, ...]:
    """Inverse of `layer_tensors`; tensors of other stages are left out."""
    count = sum(name.startswith("layers.") for name in tensors) // 2
    return tuple((tensors[f"layers.{k}.weight"], tensors[f"layers.{k}.bias"]) for k in range(count))


def format_of(file: Path, noun: str) -> object:
    """What a file says that it is: the "format" of its JSON, None if there is no such thing.

    Raises
    ------
    ValueError
        In one line, `noun` being what was wanted, for a file that cannot be read or is too large.
    """
    content = _content(file, MOST_SPEC, noun)
    try:
        found = json.loads(content.decode())
    except (ValueError, RecursionError):
        return None
    return found.get("format") if isinstance(found, dict) else None


def family(form: object) -> str:
    """A format without its version; "" for what is no format."""
    return form.rpartition("/")[0] if isinstance(form, str) else ""


def shown(value: object) -> str:
    """What a file says, as far as it fits on a line."""
    return SHORT.repr(value)


def canonical(value: object) -> str:
    """JSON of plain JSON, the same whatever its whitespace and order were."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _digest(spec: Spec) -> str:
    """Digest of all of a spec but its digest."""
    rest = {key: value for key, value in spec.items() if key != "digest"}
    return hashlib.sha256(canonical(rest).encode()).hexdigest()


def _content(file: Path, most: int, noun: str) -> bytes:
    """Content of a plain file of at most so many bytes."""
    try:
        status = file.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for
            raise ValueError(f"{file} is not a plain file: give a {noun}'s NAME.json")
        if status.st_size > most:
            raise ValueError(
                f"{file}: {_too_large(status.st_size, most)}: it is no {noun} of this project"
            )
        with file.open("rb") as handle:
            return handle.read(most)
    except FileNotFoundError:
        raise ValueError(
            f"there is no file {file}: give the path of a {noun}, its .safetensors beside it"
        ) from None
    except OSError as error:
        raise ValueError(f"cannot read {file}: {error.strerror}") from error


def _too_large(size: int, most: int) -> str:
    return f"{size} bytes, at most {most} are allowed"


def _check_keys(kind: Kind, file: Path, where: str, found: Any, known: frozenset[str]) -> None:
    again = f"write the {kind.noun} again"
    if not isinstance(found, dict):
        raise ValueError(f"{file}: {where.rstrip('.')} must be an object: {again}")  # noqa: TRY004
    for what, keys in (("unknown", found.keys() - known), ("no", known - found.keys())):
        if keys:
            raise ValueError(
                f"{file}: {what} key {shown(where + min(keys))}: {again} with this version"
            )
