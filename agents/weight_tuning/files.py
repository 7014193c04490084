"""Files of what chooses weights: weight policies, and which kind of file one is.

NAME.json says what a weight policy is, NAME.safetensors holds its network; how they are kept safe
is said in `agents.learned.container`. Beyond that a spec is read only if it is, to the last type,
what `write` makes of the policy that was read: nothing in it is guessed, rounded or left out.
"""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from safetensors.numpy import save

from agents.learned.container import (
    FAMILIES,
    Kind,
    Spec,
    canonical,
    check_suffix,
    encoded,
    family,
    format_of,
    layer_tensors,
    layers_of,
    read_spec,
    read_tensors,
    shown,
)
from agents.learned.files import LAYOUT_KEYS, layout_spec, read_layout
from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.features import SCALES, names
from agents.weight_tuning.policy import WeightPolicy
from agents.weights import FORMAT as SCHEDULE
from agents.weights import TrackingWeights, WeightSchedule
from trajectories.fileio import write_atomically

WEIGHT_POLICY = Kind(
    format="lpv-track-weights/1",
    noun="weight policy",
    keys=frozenset(("algorithm", "control_period", "layout", "choice", "features")),
    objects={
        "layout": LAYOUT_KEYS,
        "choice": frozenset(("base", "directions", "span", "catalogue", "window")),
    },
)
"""A change in what `WeightSchedule.as_dict` gives needs another version too."""

EITHER = "weight schedule or weight policy"


def write(policy: WeightPolicy, file: str | Path) -> None:
    """Write NAME.json, and NAME.safetensors beside it, each at once or not at all.

    Raises
    ------
    ValueError
        If the file's name does not end in .json, or the policy is too large for a file.
    OSError
        If a file cannot be written.
    """
    weights = save(layer_tensors(policy.layers))
    for path, content in encoded(
        WEIGHT_POLICY, Path(file), _spec(policy), policy.training, weights
    ):
        write_atomically(path, content)


def read(file: str | Path) -> WeightPolicy:
    """Read a weight policy that `write` has written; nothing of the files is run.

    Raises
    ------
    ValueError
        In one line that names the file and what to do: for files that are missing, torn, changed,
        too large, of another kind or format version, or made for other features or other entries
        of the observation.
    """
    file = Path(file)
    check_suffix(WEIGHT_POLICY, file)
    spec = read_spec(WEIGHT_POLICY, file)
    layout = read_layout(file, spec["layout"])
    choice = _choice(file, spec["choice"])
    if spec["features"] != _features(choice):
        raise ValueError(
            f"{file}: made for other features than this version's (names or scales): retrain it"
        )
    tensors = read_tensors(WEIGHT_POLICY, file, spec)
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
        raise ValueError(f"{file}: {error}") from error
    _check_as_written(file, spec, policy)
    return policy


def load(file: str | Path) -> WeightSchedule | WeightPolicy:
    """Read a file of either kind: a schedule of `WeightSchedule.write`, or a policy of `write`.

    Raises
    ------
    ValueError
        In one line that names the file, for what is neither or cannot be read.
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
    """Short hash of the features' names and scales: a policy is made for such features only."""
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
        raise ValueError(f"{file}: {place}: {' '.join(str(error).split())}") from error


def _check_as_written(file: Path, spec: Spec, policy: WeightPolicy) -> None:
    """Refuse a spec with other types, or more in it, than the policy that came of it has."""
    own = json.loads(json.dumps(_spec(policy)))  # as JSON gives it back: no tuples
    found = {key: spec[key] for key in own}
    if canonical(found) != canonical(own):
        raise ValueError(
            f"{file}: {_difference('', found, own)}: write the weight policy again with this "
            "version"
        )


def _difference(where: str, found: object, own: object) -> str:
    """Where and in what one JSON value differs from another that it should be."""
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
