"""`lpv-track import-policy`: a model of Stable-Baselines3 becomes a policy file."""

import argparse
import importlib.metadata
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands.options import (
    PREVIEW_PERIOD,
    PREVIEW_STEPS,
    add_control_period,
    file_name,
)

if TYPE_CHECKING:
    from agents.learned.policy import Policy
    from lpv_track_env.observation import ObservationLayout
    from lpv_track_env.vehicle import VehicleParameters

EXAMPLE = "lpv-track import-policy model.zip --algorithm ppo --trust --out mine.json"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "model", type=file_name, metavar="MODEL.zip", help="what model.save() wrote"
    )
    parser.add_argument("--algorithm", required=True, choices=["ppo", "sac", "td3"])
    parser.add_argument(
        "--trust", action="store_true",
        help="load it, although loading such a file runs whatever code it holds",
    )  # fmt: skip
    parser.add_argument("--out", type=file_name, required=True, metavar="NAME.json")
    parser.add_argument(
        "--vehicle", default="m2-minibus", metavar="NAME", help="driven in training"
    )
    add_control_period(parser, 0.05)
    parser.add_argument("--preview-steps", type=PREVIEW_STEPS, default=20, metavar="K")
    parser.add_argument(
        "--preview-period", type=PREVIEW_PERIOD, metavar="S", default=0.1, help="default: 0.1"
    )


def run(options: argparse.Namespace, console: Console) -> int:
    """Write the policy and return 0.

    Raises
    ------
    ValueError
        Without `--trust`, before the file is read; for a model that is no policy for such an
        environment.
    """
    if not options.trust:
        raise ValueError(
            f"{options.model} runs code of whoever made it when it is loaded: "
            "say --trust if that is you, or somebody you trust"
        )
    if options.out.suffix != ".json":
        raise ValueError(f"--out must be a .json, the weights go beside it, not {options.out}")
    from agents.learned.policy import write
    from agents.learned.sb3_policies import load_trusted
    from experiments.run.provenance import file_digest
    from lpv_track_env.observation import ObservationLayout
    from lpv_track_env.vehicle import load

    vehicle = load(options.vehicle)
    period = options.control_period
    layout = ObservationLayout(options.preview_steps, options.preview_period)
    digest = file_digest(options.model) if options.model.is_file() else ""
    model = load_trusted(options.model, options.algorithm)
    training = {
        "command": "lpv-track import-policy",
        "model": {"file": options.model.name, "sha256": digest},
        "steps": int(model.num_timesteps),
        "seed": model.seed,
        "vehicle": vehicle.name,
        "versions": {
            name: importlib.metadata.version(name) for name in ("stable-baselines3", "torch")
        },
    }
    policy = policy_of(model, layout, vehicle, period, options.algorithm, training)
    write(policy, options.out)
    console.out(
        f"{options.algorithm}, {' -> '.join(map(str, policy.sizes))}: {options.out}; "
        f"lpv-track drive --agent {options.out} drives it",
        highlight=False,
    )
    return 0


def policy_of(
    model: Any,
    layout: "ObservationLayout",
    vehicle: "VehicleParameters",
    control_period: float,
    algorithm: str,
    training: dict[str, Any],
) -> "Policy":
    """Return the policy of a model that was trained on this project's raw observations.

    The model's action space says whether its actions are in SI units, or in [-1, 1] behind
    `gymnasium.wrappers.RescaleAction`.

    Raises
    ------
    ValueError
        If its observation or action space is that of another environment.
    """
    import numpy as np
    from gymnasium import spaces

    from agents.learned.policy import Policy
    from agents.learned.sb3_policies import network_of
    from lpv_track_env.task import action_space

    size = layout.size
    seen = model.observation_space
    if not isinstance(seen, spaces.Box) or seen.shape != (size,):
        raise ValueError(
            f"the model sees {seen}, this layout has {size} entries: say "
            "--preview-steps and --preview-period as in its training"
        )
    own = action_space([vehicle])
    assert isinstance(own, spaces.Box)
    unit = spaces.Box(-1.0, 1.0, (2,), np.float32)
    acts = model.action_space
    if not any(
        isinstance(acts, spaces.Box)
        and acts.shape == known.shape
        and np.allclose(acts.low, known.low)
        and np.allclose(acts.high, known.high)
        for known in (own, unit)
    ):
        raise ValueError(
            f"the model's actions are in {acts}, those of vehicle {vehicle.name!r} "
            f"in {own}, or [-1, 1] behind RescaleAction: say --vehicle as in its training"
        )
    low, high = own.low.astype(np.float64), own.high.astype(np.float64)
    network = network_of(model)
    return Policy(
        algorithm=algorithm,
        layout=layout,
        control_period=control_period,
        feature_weight=np.eye(size, dtype=np.float32),
        feature_bias=np.zeros(size, dtype=np.float32),
        # Observations saturate at their bounds, so this clips nothing.
        feature_limit=float(layout.bound.max()),
        layers=network.layers,
        activation=network.activation,
        squash=network.squash,
        origin="zero",
        centre=0.5 * (low + high),
        half=0.5 * (high - low),
        training=training,
    )
