"""Learned policies that drive: their numbers, in SI units, and reading and writing them.

Functions called `check...` raise a ValueError that names the value and what is wrong with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.learned.context import CONTEXT
from agents.learned.files import (
    MOST_LAYERS,
    Kind,
    Layer,
    Spec,
    layer_tensors,
    layers_of,
    plain_json,
    read_files,
)
from agents.learned.storage import write_files
from lpv_track_env.observation import SCALARS, ObservationLayout
from lpv_track_env.task import checked_period
from trajectories.arguments import Number, instance_of, shortened, shown
from trajectories.naming import choose

Weights = NDArray[np.float32]
Array = NDArray[np.float64]

Activation = Literal["tanh", "relu"]
Squash = Literal["tanh", "clip"]
Origin = Literal["zero", "actuators", "lpv-nmpc"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)
SQUASHES: tuple[str, ...] = get_args(Squash)
ORIGINS: tuple[str, ...] = get_args(Origin)

ACTIONS = 2
"""Entries of an action: a, delta."""
WIDEST = 4096
"""Largest number of outputs of a layer."""

POLICY = Kind(
    format="lpv-track-policy/1",
    noun="policy",
    keys=frozenset(
        ("activation", "squash", "origin", "centre", "half", "feature_limit", "symmetric")
    ),
    stages=("features",),
    optional=frozenset(("context",)),
)


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy: features, a multilayer perceptron, and the meaning of its output.

    With o the observation in SI units (`lpv_track_env.observation`; for origin "lpv-nmpc" followed
    by the base action; then by the context)::

        x      = clip(W_f o + b_f, -limit, limit)
        x      = activation(W_k x + b_k)                    for every layer but the last
        u      = squash(W_L x + b_L)                        in [-1, 1]
        action = base + centre + half u                     [a m/s^2, delta rad]

    and the action is clipped to the vehicle's range. Arrays are copied and read-only.

    Parameters
    ----------
    algorithm
        "ppo", "sac", "td3", "bc", "residual", or any other name.
    layout
        Layout of its observations.
    control_period
        Time between its actions, s.
    feature_weight, feature_bias, feature_limit
        W_f (m, inputs), b_f (m,), limit > 0; float32.
    layers
        (W (out, in), b (out,)) of each layer, float32, the last with two outputs.
    activation
        "tanh" or "relu", after every layer but the last.
    squash
        "tanh" or "clip", of the last layer's output.
    origin
        Meaning of `base`: "zero"; "actuators", the observed actuator values, so that the policy
        commands increments; "lpv-nmpc", the action of that agent on the same observation.
    centre, half
        (2,) m/s^2 and rad, float64; half >= 0.
    training
        Origin of the policy in plain JSON: command, seed, steps, vehicle, versions, ...
    symmetric
        Use the mean of the network's output and of its mirrored output for the mirrored
        observation as u: the policy then treats left and right alike.
    context
        Names of the task's constants that the features see, of `agents.learned.context.CONTEXT`.
        With it, features see the reference that the vehicle can follow, and for origin "actuators"
        its rates replace `half`.

    Raises
    ------
    ValueError
        For shapes that do not fit together, numbers that are not finite, unknown names, more than
        16 layers, more than 4096 outputs of a layer, or a `training` that is not plain JSON.
    """

    algorithm: str
    layout: ObservationLayout
    control_period: float
    feature_weight: Weights
    feature_bias: Weights
    feature_limit: float
    layers: tuple[Layer, ...]
    activation: Activation
    squash: Squash
    origin: Origin
    centre: Array
    half: Array
    training: Mapping[str, Any] = field(default_factory=dict)
    symmetric: bool = False
    context: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        checked_name(self.algorithm)
        instance_of("layout", self.layout, ObservationLayout, "an ObservationLayout")
        choose("activation", self.activation, ACTIVATIONS)
        choose("squash", self.squash, SQUASHES)
        choose("origin", self.origin, ORIGINS)
        limit = checked_number("feature_limit", self.feature_limit)
        if not limit > 0.0:
            raise ValueError(f"feature_limit must be positive, not {limit}")
        period = checked_period(checked_number("control_period", self.control_period))
        centre, half = (_action(name, getattr(self, name)) for name in ("centre", "half"))
        if half.min() < 0.0:
            raise ValueError(f"half must not be negative, but is {half.tolist()}")
        if not isinstance(self.symmetric, bool):
            raise ValueError(  # noqa: TRY004  one type of error for all fields
                f"symmetric must be true or false, not {shown(self.symmetric)}"
            )
        if self.symmetric and centre[1] != 0.0:
            raise ValueError(f"a symmetric policy steers about 0, not about {centre[1]} rad")
        context = checked_context(self.context)
        object.__setattr__(self, "context", context)
        weight, bias = checked_layer("feature", self.feature_weight, self.feature_bias, self.inputs)
        layers = checked_layers(self.layers, len(bias), ACTIONS, "for a and delta")
        normal = {
            "control_period": period, "feature_limit": limit, "centre": centre, "half": half,
            "feature_weight": weight, "feature_bias": bias, "layers": layers,
            "training": plain_json("training", self.training),
        }  # fmt: skip
        for name, value in normal.items():
            object.__setattr__(self, name, value)

    @property
    def inputs(self) -> int:
        """Length of o: observation, base action for origin "lpv-nmpc", and context."""
        base = ACTIONS if self.origin == "lpv-nmpc" else 0
        return self.layout.size + base + len(self.context)

    @property
    def mirror(self) -> Weights:
        """Factors, 1 or -1, that exchange left and right in o, (inputs,)."""
        base = [1.0, -1.0] if self.origin == "lpv-nmpc" else []
        context = np.ones(len(self.context))
        return np.concatenate([self.layout.mirror, base, context]).astype(np.float32)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of inputs, of features, and of the outputs of every layer."""
        return self.inputs, len(self.feature_bias), *(len(bias) for _, bias in self.layers)


def write(policy: Policy, file: str | Path) -> None:
    """Write NAME.json and its weights beside it; a crash leaves this policy or the one before.

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
    if policy.context:
        spec["context"] = list(policy.context)
    tensors = {
        "features.weight": policy.feature_weight,
        "features.bias": policy.feature_bias,
        **layer_tensors(policy.layers),
    }
    write_files(POLICY, file, spec, policy.training, tensors)


def read(file: str | Path) -> Policy:
    """Read a policy written by `write`; nothing in the files is executed.

    Raises
    ------
    ValueError
        In one line that names the file and what to do: for files that are missing, torn, changed,
        too large, of another format version, or made for other entries of the observation.
    """
    file = Path(instance_of("policy", file, str | Path, "the path of a NAME.json"))
    if file.suffix == ".zip":
        raise ValueError(
            f"{file} is a model of Stable-Baselines3, which runs code when it is loaded: if you "
            f"trust it, lpv-track import-policy {file} --algorithm ppo --trust "
            f"--out {file.with_suffix('.json')}"
        )
    spec, tensors = read_files(POLICY, file)
    layout = read_layout(file, spec)
    try:
        return Policy(
            layout=layout,
            feature_weight=tensors["features.weight"],
            feature_bias=tensors["features.bias"],
            layers=layers_of(tensors),
            context=spec.get("context", ()),
            **{key: spec[key] for key in POLICY.keys | {"algorithm", "control_period", "training"}},
        )
    except ValueError as error:
        raise ValueError(f"{file}: {shortened(error)}") from error


def layout_spec(layout: ObservationLayout) -> Spec:
    """Describe an observation layout in a spec."""
    return {
        "preview_steps": layout.preview_steps,
        "preview_period": float(layout.preview_period),
        "digest": layout.digest,
        "entries": [[name, unit] for name, unit, _ in SCALARS],
    }


def read_layout(file: Path, spec: Spec) -> ObservationLayout:
    """Return the layout of a spec; refuse one with other entries than this version's."""
    described = spec["layout"]
    steps, period = described["preview_steps"], described["preview_period"]
    if type(steps) is not int or type(period) is not float:
        raise ValueError(
            f"{file}: layout.preview_steps must be an integer, preview_period a number of s"
        )
    try:
        layout = ObservationLayout(steps, period)
    except ValueError as error:
        raise ValueError(f"{file}: {shortened(error)}") from error
    if described == layout_spec(layout):
        return layout
    before, now = described["entries"], layout_spec(layout)["entries"]
    if not isinstance(before, list) or before == now:
        change = "bounds or previews"
    elif len(before) != len(now):
        change = f"{len(before)} scalar entries then, {len(now)} now"
    else:
        then, here = next((b, n) for b, n in zip(before, now, strict=True) if b != n)
        change = f"{shown(then)} then, {shown(here)} now"
    raise ValueError(f"{file}: made for an observation of other entries ({change}): retrain it")


def checked_name(algorithm: object) -> str:
    """Check that a policy's `algorithm` is a string that is not empty."""
    if not isinstance(algorithm, str) or not algorithm.strip():
        raise ValueError(f"algorithm must be a name, not {shown(algorithm)}")
    return algorithm


def checked_number(name: str, value: Any) -> float:
    """Convert a finite number to a float; booleans are refused."""
    return Number().of(name, value)


def checked_context(names: Any) -> tuple[str, ...]:
    """Check names of `CONTEXT`, each at most once."""
    instance_of("context", names, list | tuple, "a list of names")
    for name in names:
        choose("entry of the context", name, tuple(CONTEXT))
    if len(set(names)) != len(names):
        raise ValueError(f"context names an entry twice: {shown(list(names))}")
    return tuple(names)


def _array(name: str, value: ArrayLike, dtype: type[np.floating[Any]]) -> NDArray[Any]:
    try:
        given = np.asarray(value)
    except Exception as error:  # conversions of a user's object may raise anything
        raise ValueError(f"{name} is not an array of numbers: {shortened(error)}") from error
    if given.dtype.kind not in "fiu":
        raise ValueError(f"{name} is not an array of numbers, but of {given.dtype}")
    with np.errstate(over="ignore"):  # becomes infinite, which is refused below
        array = np.array(given, dtype=dtype, order="C")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has values that are not finite")
    array.setflags(write=False)
    return array


def _action(name: str, value: ArrayLike) -> Array:
    array = _array(name, value, np.float64)
    if array.shape != (ACTIONS,):
        raise ValueError(f"{name} must have shape ({ACTIONS},), not {array.shape}")
    return array


def checked_layers(
    layers: Sequence[Any], inputs: int, outputs: int, meaning: str
) -> tuple[Layer, ...]:
    """Check that layers fit one another, `inputs` and `outputs`, and copy them to float32.

    `meaning` says in the message what the outputs are for.
    """
    instance_of("layers", layers, list | tuple, "a tuple of weights and biases")
    if not 1 <= len(layers) <= MOST_LAYERS:
        raise ValueError(f"layers must be 1 to {MOST_LAYERS}, not {len(layers)}")
    checked: list[Layer] = []
    for k, pair in enumerate(layers):
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(f"layers[{k}] must be a weight and a bias")
        weight, bias = pair
        checked.append(checked_layer(f"layers[{k}]", weight, bias, inputs))
        inputs = len(checked[-1][1])
    if inputs != outputs:
        raise ValueError(f"the last layer must have {outputs} outputs, {meaning}, not {inputs}")
    return tuple(checked)


def checked_layer(name: str, weight: ArrayLike, bias: ArrayLike, inputs: int) -> Layer:
    """Check the weight (out, inputs) and bias (out,) of a layer, and copy them to float32."""
    w, b = (
        _array(f"{name} {part}", value, np.float32)
        for part, value in (("weight", weight), ("bias", bias))
    )
    if w.ndim != 2 or w.shape[1] != inputs:
        raise ValueError(f"{name} weight must have shape (outputs, {inputs}), not {w.shape}")
    if not 1 <= len(w) <= WIDEST:
        raise ValueError(f"{name} must have 1 to {WIDEST} outputs, not {len(w)}")
    if b.shape != w.shape[:1]:
        raise ValueError(f"{name} bias must have shape {w.shape[:1]}, not {b.shape}")
    return w, b
