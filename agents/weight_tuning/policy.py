"""Weight policies: networks that choose the NMPC's weights, and reading and writing them.

A file is read only if it is, to the last type, what `write` makes of the policy read from it: no
entry is guessed, rounded or ignored.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from agents.learned.files import (
    FAMILIES,
    Kind,
    Layer,
    Spec,
    canonical,
    check_suffix,
    family,
    format_of,
    layer_tensors,
    layers_of,
    plain_json,
    read_files,
)
from agents.learned.policy import (
    checked_layers,
    checked_name,
    checked_number,
    layout_spec,
    read_layout,
)
from agents.learned.storage import write_files
from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.features import SCALES, names, size
from agents.weights import FORMAT as SCHEDULE
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.task import checked_period
from trajectories.arguments import instance_of, shortened, shown

WEIGHT_POLICY = Kind(
    format="lpv-track-weights/1",
    noun="weight policy",
    keys=frozenset(("choice", "features")),
    objects={"choice": frozenset(("base", "directions", "span", "catalogue", "window"))},
)
"""A change in the result of `WeightSchedule.as_dict` needs another version, too."""

EITHER = "weight schedule or weight policy"


@dataclass(frozen=True, eq=False)
class WeightPolicy:
    """A weight policy.

    With x the features (`agents.weight_tuning.features`)::

        x      = tanh(W_k x + b_k)        for every layer but the last
        action = W_L x + b_L

    and `choice` says what an action means.

    Parameters
    ----------
    choice
        Meaning of an action; its base is copied through JSON.
    layers
        (W (out, in), b (out,)) of each layer, float32.
    layout
        Layout of the observations.
    control_period
        Time between observations, s.
    algorithm
        Name of the method that found it.
    training
        Origin of the policy, in plain JSON.

    Raises
    ------
    ValueError
        For layers that are not finite or do not fit one another, the features or the choice; for
        an invalid period; for a base or a training that is not plain JSON.
    """

    choice: WeightChoice
    layers: tuple[Layer, ...]
    layout: ObservationLayout
    control_period: float = 0.05
    algorithm: str = "rl"
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checked_name(self.algorithm)
        instance_of("choice", self.choice, WeightChoice, "a WeightChoice")
        instance_of("layout", self.layout, ObservationLayout, "an ObservationLayout")
        inputs, outputs = size(len(self.choice.bands)), self.choice.entries
        layers = checked_layers(self.layers, inputs, outputs, "as the choice has entries")
        base = WeightSchedule.from_dict(plain_json("choice.base", self.choice.schedule.as_dict()))
        period = checked_number("control_period", self.control_period)
        normal = {
            "choice": replace(self.choice, base=base),
            "layers": layers,
            "control_period": checked_period(period),
            "training": plain_json("training", self.training),
        }
        for name, value in normal.items():
            object.__setattr__(self, name, value)


def write(policy: WeightPolicy, file: str | Path) -> None:
    """Write NAME.json and its weights beside it; a crash leaves this policy or the one before.

    Raises
    ------
    ValueError
        If the file's name does not end in .json, or the policy is too large for a file.
    OSError
        If a file cannot be written.
    """
    write_files(WEIGHT_POLICY, file, _spec(policy), policy.training, layer_tensors(policy.layers))


def read(file: str | Path) -> WeightPolicy:
    """Read a weight policy written by `write`; nothing in the files is executed.

    Raises
    ------
    ValueError
        In one line that names the file and what to do: for files that are missing, torn, changed,
        too large, of another kind or format version, or made for other features or other entries
        of the observation.
    """
    file = Path(file)
    spec, tensors = read_files(WEIGHT_POLICY, file)
    layout = read_layout(file, spec)
    choice = _choice(file, spec["choice"])
    if spec["features"] != _features(choice):
        raise ValueError(
            f"{file}: made for other features than this version's (names or scales): retrain it"
        )
    try:
        policy = WeightPolicy(
            choice=choice,
            layers=layers_of(tensors),
            layout=layout,
            control_period=spec["control_period"],
            algorithm=spec["algorithm"],
            training=spec["training"],
        )
    except ValueError as error:
        raise ValueError(f"{file}: {shortened(error)}") from error
    _check_as_written(file, spec, policy)
    return policy


def load(file: str | Path) -> WeightSchedule | WeightPolicy:
    """Read a weight schedule or a weight policy, whichever the file contains.

    Raises
    ------
    ValueError
        In one line that names the file, if it is neither or cannot be read.
    """
    file = Path(file)
    if file.suffix == ".safetensors":
        check_suffix(WEIGHT_POLICY, file)
    kind = family(format_of(file, EITHER))
    if kind == family(SCHEDULE):
        return WeightSchedule.read(file)
    if kind == family(WEIGHT_POLICY.format):
        return read(file)
    if kind in FAMILIES:
        raise ValueError(f"{file} {FAMILIES[kind]}")
    raise ValueError(
        f"{file} is no {EITHER}: give the .json of a schedule ({SCHEDULE}) or of a policy "
        f"({WEIGHT_POLICY.format})"
    )


def _spec(policy: WeightPolicy) -> Spec:
    choice = policy.choice
    return {
        "algorithm": policy.algorithm,
        "control_period": policy.control_period,
        "layout": layout_spec(policy.layout),
        "choice": {
            "base": choice.schedule.as_dict(),
            "directions": choice.directions,
            "span": choice.span,
            "catalogue": [asdict(one) for one in choice.catalogue],
            "window": choice.window,
        },
        "features": _features(choice),
    }


def _features(choice: WeightChoice) -> str:
    """Short hash of the names and scales of the features that a policy is made for."""
    parts = [names(choice.bands.names), SCALES.tolist()]
    return hashlib.sha256(canonical(parts).encode()).hexdigest()[:16]


def _choice(file: Path, spec: Spec) -> WeightChoice:
    place = "choice.base"
    try:
        base = WeightSchedule.from_dict(spec["base"])
        place = "choice.catalogue"
        catalogue = tuple(TrackingWeights(**one) for one in spec["catalogue"])
        place = "choice"
        return WeightChoice(base, spec["directions"], spec["span"], catalogue, spec["window"])
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{file}: {place}: {shortened(error)}") from error


def _check_as_written(file: Path, spec: Spec, policy: WeightPolicy) -> None:
    """Check that a spec has the types and the entries that `write` would give it."""
    own = json.loads(json.dumps(_spec(policy)))  # as read from JSON: lists in place of tuples
    found = {key: spec[key] for key in own}
    if canonical(found) != canonical(own):
        raise ValueError(
            f"{file}: {_difference('', found, own)}: write the weight policy again with this "
            "version"
        )


def _difference(where: str, found: object, own: object) -> str:
    """Describe the first difference between two JSON values, `own` being the right one."""
    pairs: list[tuple[str, object, object]] = []
    if isinstance(found, dict) and isinstance(own, dict):
        for what, keys in (("unknown", found.keys() - own.keys()), ("no", own.keys() - found)):
            if keys:
                return f"{what} key {shown(f'{where}.{min(keys)}'.lstrip('.'))}"
        pairs = [(f"{where}.{key}".lstrip("."), found[key], own[key]) for key in own]
    elif isinstance(found, list) and isinstance(own, list) and len(found) == len(own):
        pairs = [(f"{where}[{k}]", *pair) for k, pair in enumerate(zip(found, own, strict=True))]
    for place, one, other in pairs:
        if canonical(one) != canonical(other):
            return _difference(place, one, other)
    return f"{where} is {shown(found)}, not {shown(own)}"
