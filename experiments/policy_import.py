"""`lpv-track import-policy`: a model of Stable-Baselines3 becomes a policy file."""

import argparse
import hashlib
import importlib.metadata
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from agents.learned.policy import Policy, write
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.task import action_space
from lpv_track_env.vehicle import VehicleParameters, load


def run_import(options: argparse.Namespace, console: Any) -> int:
    """Write the policy; 0 if it is written.

    Raises
    ------
    ValueError
        Without `--trust`, with nothing of the file read; for a model that is no policy for such an
        environment.
    """
    if not options.trust:
        raise ValueError(
            f"{options.model} runs code of whoever made it when it is loaded: "
            "say --trust if that is you, or somebody you trust"
        )
    if options.out.suffix != ".json":
        raise ValueError(f"--out must be a .json, the weights go beside it, not {options.out}")
    vehicle = load(options.vehicle)
    period = options.control_period
    layout = ObservationLayout(
        options.preview_steps,
        period if options.preview_period is None else options.preview_period,
    )
    from agents.learned.sb3_policies import load_trusted

    digest = ""
    if options.model.is_file():
        digest = hashlib.sha256(options.model.read_bytes()).hexdigest()
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
    console.print(
        f"{options.algorithm}, {' -> '.join(map(str, policy.sizes))}: {options.out}; "
        f"lpv-track drive --agent {options.out} drives it",
        markup=False, highlight=False, soft_wrap=True,
    )  # fmt: skip
    return 0


def policy_of(
    model: Any,
    layout: ObservationLayout,
    vehicle: VehicleParameters,
    control_period: float,
    algorithm: str,
    training: dict[str, Any],
) -> Policy:
    """Policy of a model that was trained on this project's environment, its observations raw.

    Its actions are in SI units, or in [-1, 1] behind `gymnasium.wrappers.RescaleAction`: its
    action space tells.

    Raises
    ------
    ValueError
        If its observation or action space is that of another environment.
    """
    from agents.learned.sb3_policies import network_of

    size = layout.size
    if np.shape(model.observation_space.low if _box(model.observation_space) else ()) != (size,):
        raise ValueError(
            f"the model sees {model.observation_space}, this layout has {size} entries: say "
            "--preview-steps and --preview-period as in its training"
        )
    own = action_space([vehicle])
    assert isinstance(own, spaces.Box)
    unit = spaces.Box(-1.0, 1.0, (2,), np.float32)
    if not any(_same_range(model.action_space, known) for known in (own, unit)):
        raise ValueError(
            f"the model's actions are in {model.action_space}, those of vehicle {vehicle.name!r} "
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


def _box(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, spaces.Box)


def _same_range(space: gymnasium.Space[Any], known: spaces.Box) -> bool:
    return (
        isinstance(space, spaces.Box)
        and space.shape == known.shape
        and np.allclose(space.low, known.low)
        and np.allclose(space.high, known.high)
    )
