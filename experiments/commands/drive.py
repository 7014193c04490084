"""`lpv-track drive`: watch a run live, write frames or a video, agents side by side."""

import argparse
from pathlib import Path

from rich.console import Console

from experiments.commands.options import (
    add_conditions,
    add_seed,
    add_settings,
    add_vehicle,
    conditions_of,
    parse_settings,
)

EXAMPLE = "lpv-track drive --agents lpv-nmpc pure-pursuit --trajectory T2 --video out.mp4"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--agent", metavar="NAME", help="default: lpv-nmpc")
    parser.add_argument(
        "--agents", nargs="+", metavar="NAME", help="drive the same case, side by side"
    )
    parser.add_argument("--trajectory", default="T2", metavar="NAME")
    add_vehicle(parser)
    parser.add_argument("--speed-mode", default="variable", choices=["variable", "fixed"])
    add_conditions(parser)
    add_seed(parser)
    add_settings(parser, "--agent-set")
    add_settings(parser, "--env")
    parser.add_argument(
        "--frames", type=Path, metavar="DIR", help="write PNG frames, open no window"
    )
    parser.add_argument("--every", type=int, default=1, metavar="N", help="a frame every N steps")
    parser.add_argument(
        "--video", type=Path, metavar="FILE",
        help="write a video, .mp4 or .gif; needs pip install 'lpv-track-env[video]'",
    )  # fmt: skip
    parser.add_argument(
        "--fps", type=float, metavar="N",
        help="frames a second of the video (default: one a control period, at most 50)",
    )  # fmt: skip
    parser.add_argument(
        "--speed-up", type=float, default=1.0, metavar="X",
        help="how many times faster than real time the video runs (default 1)",
    )  # fmt: skip
    parser.add_argument(
        "--colour", default="speed", metavar="WHAT",
        help="of the path: speed (default) or curvature",
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.drive import drive
    from experiments.run.case import Case

    if options.agent is not None and options.agents:
        raise ValueError("give --agent or --agents, not both")
    names = options.agents or [options.agent or "lpv-nmpc"]
    case = Case(
        agent=names[0],
        trajectory=options.trajectory,
        vehicle=options.vehicle,
        speed_mode=options.speed_mode,
        conditions=conditions_of(options),
        seed=options.seed,
        agent_settings=parse_settings(options.agent_set),
        env_settings=parse_settings(options.env),
    )
    return drive(
        case, console, names=names, frames=options.frames, every=options.every,
        video=options.video, fps=options.fps, speed_up=options.speed_up, colour=options.colour,
    )  # fmt: skip
