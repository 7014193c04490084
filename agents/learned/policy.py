"""What a learned policy is: numbers only, checked, in SI units."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NoReturn, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.observation import ObservationLayout
from lpv_track_env.task import checked_period
from trajectories.naming import choose

Weights = NDArray[np.float32]
Array = NDArray[np.float64]
Layer = tuple[Weights, Weights]

Activation = Literal["tanh", "relu"]
Squash = Literal["tanh", "clip"]
Origin = Literal["zero", "actuators", "lpv-nmpc"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)
SQUASHES: tuple[str, ...] = get_args(Squash)
ORIGINS: tuple[str, ...] = get_args(Origin)

ACTIONS = 2
"""a, delta."""
MOST_LAYERS = 16
WIDEST = 4096


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy as a file holds it: features, a multilayer perceptron, and what its output means.

    With o the observation in SI units (`lpv_track_env.observation`; for origin "lpv-nmpc" followed
    by the base action)::

        x      = clip(W_f o + b_f, -limit, limit)
        x      = activation(W_k x + b_k)                    for every layer but the last
        u      = squash(W_L x + b_L)                        in [-1, 1]
        action = base + centre + half u                     [a m/s^2, delta rad]

    and the action is clipped to the vehicle's range.

    Parameters
    ----------
    algorithm
        "ppo", "sac", "td3", "bc", "residual", or what its maker calls it.
    layout
        Observations that it was made for.
    control_period
        s, that it was made for.
    feature_weight, feature_bias, feature_limit
        W_f (m, inputs), b_f (m,), limit > 0; float32.
    layers
        (W (out, in), b (out,)) of each layer, float32, the last with two outputs.
    activation
        "tanh" or "relu", after every layer but the last.
    squash
        "tanh" or "clip", of the last layer's output.
    origin
        What `base` is: "zero"; "actuators", the values in force in the observation, so that the
        policy commands increments; "lpv-nmpc", that agent's action on the same observation.
    centre, half
        (2,) m/s^2 and rad, float64; half >= 0.
    training
        Where it comes from, in plain JSON: command, seed, steps, vehicle, versions, ...
    symmetric
        Whether u is the mean of the network's output and, mirrored back, of its output for the
        mirrored observation: left and right are then the same to the policy.

    Arrays are copied and read-only.

    Raises
    ------
    ValueError
        Naming what is wrong: shapes that do not fit together, numbers that are not finite, unknown
        names, more than 16 layers or 4096 values in one, a `training` that is not JSON.
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

    def __post_init__(self) -> None:
        if not isinstance(self.algorithm, str) or not self.algorithm.strip():
            raise ValueError(f"algorithm must be a name, not {self.algorithm!r}")
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
        _check_symmetry(self.symmetric, centre)
        weight, bias = checked_layer("feature", self.feature_weight, self.feature_bias, self.inputs)
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise ValueError(f"layers must be 1 to {MOST_LAYERS}, not {len(self.layers)}")
        layers: list[Layer] = []
        for k, pair in enumerate(self.layers):
            if not isinstance(pair, tuple | list) or len(pair) != 2:
                raise ValueError(f"layers[{k}] must be a weight and a bias")
            layers.append(
                checked_layer(f"layers[{k}]", *pair, len(layers[-1][1] if layers else bias))
            )
        if len(layers[-1][1]) != ACTIONS:
            raise ValueError(
                f"the last layer must have {ACTIONS} outputs, for a and delta, "
                f"not {len(layers[-1][1])}"
            )
        normal = {
            "control_period": period, "feature_limit": limit, "centre": centre, "half": half,
            "feature_weight": weight, "feature_bias": bias, "layers": tuple(layers),
            "training": plain_json("training", self.training),
        }  # fmt: skip
        for name, value in normal.items():
            object.__setattr__(self, name, value)

    @property
    def inputs(self) -> int:
        """Length of o: the observation, and for origin "lpv-nmpc" the base action."""
        return self.layout.size + (ACTIONS if self.origin == "lpv-nmpc" else 0)

    @property
    def mirror(self) -> Weights:
        """Factor of each entry of o where left and right are exchanged, (inputs,)."""
        base = [1.0, -1.0] if self.origin == "lpv-nmpc" else []
        return np.concatenate([self.layout.mirror, base]).astype(np.float32)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Values at each stage: inputs, features, and the outputs of every layer."""
        return self.inputs, len(self.feature_bias), *(len(bias) for _, bias in self.layers)


def plain_json(name: str, value: object) -> dict[str, Any]:
    """Copy a mapping that is plain JSON, as JSON gives it back: tuples become lists.

    Raises
    ------
    ValueError
        If it is not a mapping, or holds what JSON does not.
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping, not {type(value).__name__}")  # noqa: TRY004
    try:
        return parse_json(json.dumps(dict(value), allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{name} must be plain JSON with finite numbers: {error}") from error


def parse_json(text: str) -> dict[str, Any]:
    """Parse a JSON object: no key twice, no NaN, no infinity.

    Raises
    ------
    ValueError
        Saying where or what.
    """
    try:
        found = json.loads(text, object_pairs_hook=_once, parse_constant=_refuse)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f"a JSON {type(found).__name__}, not an object")  # noqa: TRY004
    return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"key {twice!r} twice")
    return found


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def _check_symmetry(symmetric: object, centre: Array) -> None:
    if not isinstance(symmetric, bool):
        raise ValueError(f"symmetric must be true or false, not {symmetric!r}")  # noqa: TRY004
    if symmetric and centre[1] != 0.0:
        raise ValueError(f"a symmetric policy steers about 0, not about {centre[1]} rad")


def checked_number(name: str, value: Any) -> float:
    """Value as a float, if it is a number and finite.

    Raises
    ------
    ValueError
        Naming it, for anything else; True and False are no numbers.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ValueError(f"{name} must be a number, not {value!r}")  # noqa: TRY004
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, not {number}")
    return number


def _array(name: str, value: ArrayLike, dtype: type[np.floating[Any]]) -> NDArray[Any]:
    try:
        given = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not an array of numbers: {error}") from error
    if given.dtype.kind not in "fiu":
        raise ValueError(f"{name} is not an array of numbers, but of {given.dtype}")
    with np.errstate(over="ignore"):  # beyond float32 is not finite, below
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


def checked_layer(name: str, weight: ArrayLike, bias: ArrayLike, inputs: int) -> Layer:
    """Weight (out, inputs) and bias (out,) of a layer, float32.

    Raises
    ------
    ValueError
        If they do not fit, naming the layer.
    """
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
