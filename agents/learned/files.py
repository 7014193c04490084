"""Policy files: NAME.json says what a policy is, NAME.safetensors holds its weights.

Reading runs nothing that the files say: JSON and plain numbers, nothing is unpickled. The spec has
a digest of itself and one of the weights, so a change in either is refused before it is used. (The
digests find accidents. Who wants to can write another policy; it cannot do more than drive badly.)
"""

import hashlib
import json
import re
import reprlib
import stat
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from numpy.typing import NDArray
from safetensors.numpy import save

from agents.learned.policy import MOST_LAYERS, Policy, parse_json
from lpv_track_env.observation import SCALARS, ObservationLayout
from trajectories.atomic import write_atomically

FORMAT = "lpv-track-policy/1"
MOST_WEIGHTS = 64 * 2**20
MOST_SPEC = 2**20
"""Bytes; a larger file is neither written nor read."""

KEYS = frozenset(
    (
        "format", "algorithm", "control_period", "layout", "activation", "squash", "origin",
        "centre", "half", "feature_limit", "symmetric", "weights", "training", "digest",
    )
)  # fmt: skip
LAYOUT_KEYS = frozenset(("preview_steps", "preview_period", "digest", "entries"))
WEIGHTS_KEYS = frozenset(("file", "sha256", "bytes"))

BESIDE = re.compile(r"[^/\\:\x00-\x1f\x7f]+\.safetensors")
"""Names of weights: in the spec's own folder, on every system."""

SHORT = reprlib.Repr()
SHORT.maxstring = 80

Spec = dict[str, Any]
Tensors = dict[str, NDArray[np.float32]]


def write(policy: Policy, file: str | Path) -> None:
    """Write NAME.json, and NAME.safetensors beside it, each at once or not at all.

    The weights come first, so that a spec never names weights that are not there.

    Raises
    ------
    ValueError
        If the file's name does not end in .json, or the policy is too large for a file.
    OSError
        If a file cannot be written.
    """
    file = Path(file)
    if file.suffix != ".json":
        raise ValueError(f"{file}: a policy is written to NAME.json, give it such a name")
    weights = save(_tensors(policy))
    beside = file.with_suffix(".safetensors")
    if not BESIDE.fullmatch(beside.name):
        raise ValueError(f"{file.name!r} is no name for a policy: leave out \\, : and the like")
    spec: Spec = {
        "format": FORMAT,
        "algorithm": policy.algorithm,
        "control_period": policy.control_period,
        "layout": _layout_spec(policy.layout),
        "activation": policy.activation,
        "squash": policy.squash,
        "origin": policy.origin,
        "centre": policy.centre.tolist(),
        "half": policy.half.tolist(),
        "feature_limit": policy.feature_limit,
        "symmetric": policy.symmetric,
        "weights": {
            "file": beside.name, "sha256": hashlib.sha256(weights).hexdigest(),
            "bytes": len(weights),
        },
        "training": policy.training,
    }  # fmt: skip
    text = json.dumps({**spec, "digest": _digest(spec)}, indent=2, allow_nan=False) + "\n"
    for content, most in ((weights, MOST_WEIGHTS), (text.encode(), MOST_SPEC)):
        if len(content) > most:
            raise ValueError(f"{file}: {_too_large(len(content), most)}: make the policy smaller")
    write_atomically(beside, weights)
    write_atomically(file, text.encode())


def read(file: str | Path) -> Policy:
    """Read a policy that `write` has written; nothing of the files is run.

    Raises
    ------
    ValueError
        In one line that names the file and what to do: for files that are missing, torn, changed,
        too large, of another format version, or made for other entries of the observation.
    """
    file = Path(file)
    _check_suffix(file)
    spec = _spec(file)
    layout = _layout(file, spec["layout"])
    tensors = _weights(file, spec["weights"])
    try:
        return Policy(
            algorithm=spec["algorithm"],
            layout=layout,
            control_period=spec["control_period"],
            feature_weight=tensors["features.weight"],
            feature_bias=tensors["features.bias"],
            feature_limit=spec["feature_limit"],
            layers=tuple(
                (tensors[f"layers.{k}.weight"], tensors[f"layers.{k}.bias"])
                for k in range(len(tensors) // 2 - 1)
            ),
            activation=spec["activation"],
            squash=spec["squash"],
            origin=spec["origin"],
            centre=spec["centre"],
            half=spec["half"],
            training=spec["training"],
            symmetric=spec["symmetric"],
        )
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _check_suffix(file: Path) -> None:
    if file.suffix == ".json":
        return
    if file.suffix == ".zip":
        raise ValueError(
            f"{file} is a model of Stable-Baselines3, which runs code when it is loaded: if you "
            f"trust it, lpv-track import-policy {file} --algorithm ppo --trust "
            f"--out {file.with_suffix('.json')}"
        )
    if file.suffix == ".safetensors":
        raise ValueError(
            f"{file} holds a policy's weights alone: give its spec, {file.with_suffix('.json')}"
        )
    raise ValueError(f"{file} is no policy file: give the NAME.json that it was written to")


def _content(file: Path, most: int) -> bytes:
    """Content of a plain file of at most so many bytes."""
    try:
        status = file.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for
            raise ValueError(f"{file} is not a plain file: give a policy's NAME.json")
        if status.st_size > most:
            raise ValueError(
                f"{file}: {_too_large(status.st_size, most)}: it is no policy of this project"
            )
        with file.open("rb") as handle:
            return handle.read(most)
    except FileNotFoundError:
        raise ValueError(
            f"there is no file {file}: give the path of a policy, its .safetensors beside it"
        ) from None
    except OSError as error:
        raise ValueError(f"cannot read {file}: {error.strerror}") from error


def _too_large(size: int, most: int) -> str:
    return f"{size} bytes, at most {most} are allowed"


def _shown(value: object) -> str:
    """What a file says, as far as it fits on a line."""
    return SHORT.repr(value)


def _digest(spec: Spec) -> str:
    """Digest of all of a spec but its digest, whatever its whitespace and order."""
    rest = {key: value for key, value in spec.items() if key != "digest"}
    canonical = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _spec(file: Path) -> Spec:
    """The spec, complete and unchanged since it was written."""
    content = _content(file, MOST_SPEC)
    try:
        spec = parse_json(content.decode())
    except UnicodeDecodeError:
        raise ValueError(f"{file} is not JSON but binary: give a policy's NAME.json") from None
    except ValueError as error:
        raise ValueError(f"{file} is not a policy's JSON: {error}: copy it anew") from error
    form = spec.get("format")
    if form != FORMAT:
        raise ValueError(
            f"{file}: format is {_shown(form)}, this version reads {FORMAT!r}: retrain or upgrade"
        )
    _check_keys(file, "", spec, KEYS)
    _check_keys(file, "layout.", spec["layout"], LAYOUT_KEYS)
    _check_keys(file, "weights.", spec["weights"], WEIGHTS_KEYS)
    try:
        unchanged = spec["digest"] == _digest(spec)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not a policy's JSON: {error}: copy it anew") from error
    if not unchanged:
        raise ValueError(
            f"{file} was changed since it was written: copy it anew, or write the policy again"
        )
    return spec


def _check_keys(file: Path, where: str, found: Any, known: frozenset[str]) -> None:
    if not isinstance(found, dict):
        raise ValueError(f"{file}: {where.rstrip('.')} must be an object: write the policy again")  # noqa: TRY004
    for what, keys in (("unknown", found.keys() - known), ("no", known - found.keys())):
        if keys:
            raise ValueError(
                f"{file}: {what} key {_shown(where + min(keys))}: "
                "write the policy again with this version"
            )


def _layout_spec(layout: ObservationLayout) -> Spec:
    return {
        "preview_steps": layout.preview_steps,
        "preview_period": float(layout.preview_period),
        "digest": layout.digest,
        "entries": [[name, unit] for name, unit, _ in SCALARS],
    }


def _layout(file: Path, spec: Spec) -> ObservationLayout:
    """The layout of a spec, if this version's entries are those that the policy was made for."""
    steps, period = spec["preview_steps"], spec["preview_period"]
    if type(steps) is not int or type(period) is not float:
        raise ValueError(
            f"{file}: layout.preview_steps must be an integer, preview_period a number of s"
        )
    try:
        layout = ObservationLayout(steps, period)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    if spec == _layout_spec(layout):
        return layout
    before, now = spec["entries"], _layout_spec(layout)["entries"]
    if not isinstance(before, list) or before == now:
        change = "bounds or previews"
    elif len(before) != len(now):
        change = f"{len(before)} scalar entries then, {len(now)} now"
    else:
        then, here = next((b, n) for b, n in zip(before, now, strict=True) if b != n)
        change = f"{_shown(then)} then, {_shown(here)} now"
    raise ValueError(f"{file}: made for an observation of other entries ({change}): retrain it")


def _tensors(policy: Policy) -> Tensors:
    tensors = {"features.weight": policy.feature_weight, "features.bias": policy.feature_bias}
    for k, (weight, bias) in enumerate(policy.layers):
        tensors |= {f"layers.{k}.weight": weight, f"layers.{k}.bias": bias}
    return tensors


def _weights(file: Path, spec: Spec) -> Tensors:
    """The tensors that a spec names, if they are the very bytes that were written."""
    name = spec["file"]
    if not isinstance(name, str) or not BESIDE.fullmatch(name):
        raise ValueError(
            f"{file}: weights.file is {_shown(name)}, not a .safetensors in the same folder: "
            "write the policy again"
        )
    beside = file.parent / name
    content = _content(beside, MOST_WEIGHTS)
    if len(content) != spec["bytes"]:
        raise ValueError(
            f"{beside} has {len(content)} bytes, {spec['bytes']} were written: copy it anew"
        )
    if hashlib.sha256(content).hexdigest() != spec["sha256"]:
        raise ValueError(
            f"{beside} was changed since it was written: copy it anew, together with {file.name}"
        )
    try:
        found = dict(safetensors.deserialize(content))  # type: ignore[no-untyped-call]
    except safetensors.SafetensorError as error:
        raise ValueError(f"{beside} is not safetensors: {error}: write the policy again") from error
    layers = len({name.rpartition(".")[0] for name in found} - {"features"})
    stages = ["features", *(f"layers.{k}" for k in range(min(max(layers, 1), MOST_LAYERS)))]
    names = {f"{stage}.{part}" for stage in stages for part in ("weight", "bias")}
    if names != found.keys():
        raise ValueError(
            f"{beside}: tensors {_shown(sorted(names ^ found.keys()))} are missing or unknown: "
            "write the policy again"
        )
    for tensor, value in found.items():
        if value["dtype"] != "F32":
            raise ValueError(
                f"{beside}: {tensor} is {value['dtype']}, not F32: write the policy again"
            )
    return {
        tensor: np.frombuffer(value["data"], dtype="<f4").reshape(value["shape"])
        for tensor, value in found.items()
    }
