"""Policy files: NAME.json says what a policy is, NAME.safetensors holds its weights.

How they are kept safe is said in `agents.learned.container`.
"""

from pathlib import Path

import safetensors.numpy

from agents.learned.container import (
    Kind,
    Spec,
    Tensors,
    check_suffix,
    encoded,
    layer_tensors,
    layers_of,
    read_spec,
    read_tensors,
    shown,
)
from agents.learned.policy import Policy
from lpv_track_env.observation import SCALARS, ObservationLayout
from trajectories.fileio import write_atomically

LAYOUT_KEYS = frozenset(("preview_steps", "preview_period", "digest", "entries"))

POLICY = Kind(
    format="lpv-track-policy/1",
    noun="policy",
    keys=frozenset(
        (
            "algorithm", "control_period", "layout", "activation", "squash", "origin", "centre",
            "half", "feature_limit", "symmetric",
        )
    ),
    objects={"layout": LAYOUT_KEYS},
)  # fmt: skip


def write(policy: Policy, file: str | Path) -> None:
    """Write NAME.json, and NAME.safetensors beside it, each at once or not at all.

    Raises
    ------
    ValueError
        If the file's name does not end in .json, or the policy is too large for a file.
    OSError
        If a file cannot be written.
    """
    spec: Spec = {
        "algorithm": policy.algorithm,
        "control_period": policy.control_period,
        "layout": layout_spec(policy.layout),
        "activation": policy.activation,
        "squash": policy.squash,
        "origin": policy.origin,
        "centre": policy.centre.tolist(),
        "half": policy.half.tolist(),
        "feature_limit": policy.feature_limit,
        "symmetric": policy.symmetric,
    }
    weights = safetensors.numpy.save(_tensors(policy))
    for path, content in encoded(POLICY, Path(file), spec, policy.training, weights):
        write_atomically(path, content)


def read(file: str | Path) -> Policy:
    """Read a policy that `write` has written; nothing of the files is run.

    Raises
    ------
    ValueError
        In one line that names the file and what to do: for files that are missing, torn, changed,
        too large, of another format version, or made for other entries of the observation.
    """
    file = Path(file)
    _refuse_models(file)
    check_suffix(POLICY, file)
    spec = read_spec(POLICY, file)
    layout = read_layout(file, spec["layout"])
    tensors = read_tensors(POLICY, file, spec, before=("features",))
    try:
        return Policy(
            algorithm=spec["algorithm"],
            layout=layout,
            control_period=spec["control_period"],
            feature_weight=tensors["features.weight"],
            feature_bias=tensors["features.bias"],
            feature_limit=spec["feature_limit"],
            layers=layers_of(tensors),
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


def _refuse_models(file: Path) -> None:
    if file.suffix == ".zip":
        raise ValueError(
            f"{file} is a model of Stable-Baselines3, which runs code when it is loaded: if you "
            f"trust it, lpv-track import-policy {file} --algorithm ppo --trust "
            f"--out {file.with_suffix('.json')}"
        )


def _tensors(policy: Policy) -> Tensors:
    features = {"features.weight": policy.feature_weight, "features.bias": policy.feature_bias}
    return {**features, **layer_tensors(policy.layers)}


def layout_spec(layout: ObservationLayout) -> Spec:
    """What the spec of any policy says of the observations that it was made for."""
    return {
        "preview_steps": layout.preview_steps,
        "preview_period": float(layout.preview_period),
        "digest": layout.digest,
        "entries": [[name, unit] for name, unit, _ in SCALARS],
    }


def read_layout(file: Path, spec: Spec) -> ObservationLayout:
    """Layout of a spec, if this version's entries are those that the policy was made for.

    Raises
    ------
    ValueError
        In one line that names the file: for another's entries, or what is no layout.
    """
    steps, period = spec["preview_steps"], spec["preview_period"]
    if type(steps) is not int or type(period) is not float:
        raise ValueError(
            f"{file}: layout.preview_steps must be an integer, preview_period a number of s"
        )
    try:
        layout = ObservationLayout(steps, period)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    if spec == layout_spec(layout):
        return layout
    before, now = spec["entries"], layout_spec(layout)["entries"]
    if not isinstance(before, list) or before == now:
        change = "bounds or previews"
    elif len(before) != len(now):
        change = f"{len(before)} scalar entries then, {len(now)} now"
    else:
        then, here = next((b, n) for b, n in zip(before, now, strict=True) if b != n)
        change = f"{shown(then)} then, {shown(here)} now"
    raise ValueError(f"{file}: made for an observation of other entries ({change}): retrain it")
