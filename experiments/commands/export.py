"""`lpv-track export`: a learned policy becomes an ONNX model, checked against the agent."""

import argparse

from rich.console import Console

from experiments.commands.options import file_name

EXAMPLE = "lpv-track export ppo --out ppo.onnx"

TOLERANCE = 1e-4
"""Largest difference of an action (m/s^2, rad) to the agent's own code: rounding in float32."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("agent", metavar="AGENT", help="ppo, sac, bc, or a policy's NAME.json")
    parser.add_argument("--out", type=file_name, required=True, metavar="FILE.onnx")
    parser.add_argument(
        "--vehicle", default="m2-minibus", metavar="NAME",
        help="has the bounds, and the constants for a policy that drives many vehicles "
        "(default: m2-minibus)",
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Write the model and return 0.

    Raises
    ------
    ValueError
        For an agent that is no learned policy, without the packages, or if the model disagrees with
        the agent.
    """
    if options.out.suffix != ".onnx":
        raise ValueError(f"--out must be a .onnx, not {options.out}")
    try:
        import onnxruntime  # noqa: F401

        from agents.learned.onnx_model import difference, model_of
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{error.name} is not installed: pip install 'lpv-track-env[export]'"
        ) from None
    from agents.base import CHECKPOINTS, DrivingTask
    from agents.learned.policy import read
    from lpv_track_env.env import PathTrackingEnv
    from trajectories.fileio import write_atomically

    name = options.agent
    if not name.endswith(".json") and name not in {"ppo", "sac", "bc"}:
        raise ValueError(f"{name} is no learned policy: give ppo, sac, bc or a policy's NAME.json")
    policy = read(name if name.endswith(".json") else CHECKPOINTS / f"{name}.json")
    env = PathTrackingEnv(
        "T2", options.vehicle, control_period=policy.control_period,
        preview_steps=policy.layout.preview_steps, preview_period=policy.layout.preview_period,
    )  # fmt: skip
    task = DrivingTask.of(env)
    model = model_of(policy, task)
    found = difference(policy, task, model)
    if not found < TOLERANCE:
        raise ValueError(f"the model differs from the agent by {found:g}: please report it")
    write_atomically(options.out, model.SerializeToString())
    console.out(
        f"{options.out}: observation (n, {policy.layout.size}) -> action (n, 2) for "
        f"{task.vehicle.name}; within {found:.1e} of the agent on 1000 random observations",
        highlight=False,
    )
    if policy.context:
        console.out(
            "it wants the previews that the vehicle can follow: agents.learned.context.Followed",
            highlight=False,
        )
    return 0
