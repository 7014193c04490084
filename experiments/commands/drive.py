"""`lpv-track drive`: watch a run live, write frames or a video, agents side by side."""

import argparse

from rich.console import Console

from experiments.commands import options as shared

EXAMPLE = "lpv-track drive --agents lpv-nmpc pure-pursuit --trajectory T2 --video out.mp4"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    shared.add_agents(parser, "default: lpv-nmpc; several drive the same case, side by side")
    shared.add_trajectories(parser, ["T2"])
    shared.add_vehicles(parser, ["m2-minibus"])
    shared.add_speed_modes(parser, None)
    shared.add_conditions(parser)
    shared.add_seed(parser)
    shared.add_agent_settings(parser)
    shared.add_settings(parser, "--env")
    shared.add_start(parser)
    parser.add_argument(
        "--frames", type=shared.file_name, metavar="DIR", help="write PNG frames, open no window"
    )
    parser.add_argument(
        "--every", type=shared.whole(1, 10**9), default=1, metavar="N", help="a frame every N steps"
    )
    parser.add_argument(
        "--video", type=shared.file_name, metavar="FILE",
        help="write a video, .mp4 or .gif; needs pip install 'lpv-track-env[video]'",
    )  # fmt: skip
    parser.add_argument(
        "--fps", type=shared.number(0.0, 240.0, above=True), metavar="N",
        help="frames a second of the video (default: one a control period, at most 50)",
    )  # fmt: skip
    parser.add_argument(
        "--speed-up", type=shared.number(0.01, 1000.0), default=1.0, metavar="X",
        help="how many times faster than real time the video runs (default 1)",
    )  # fmt: skip
    parser.add_argument(
        "--colour", default="speed", metavar="NAME",
        help="quantity that colours the path: speed (default) or curvature",
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command and return its exit code."""
    from experiments.drive import drive
    from experiments.run.case import Case

    names = options.agents or ["lpv-nmpc"]
    settings = shared.agent_settings(options.agent_set, names)
    speed_modes = shared.speed_modes_of(options) or ["variable"]
    cases = [
        Case(
            agent=name,
            trajectory=shared.only_one("trajectory", options.trajectories),
            vehicle=shared.only_one("vehicle", options.vehicles),
            speed_mode=shared.only_one("speed mode", speed_modes),
            grip=shared.only_one("share of grip", options.grip or [None]),
            conditions=shared.conditions_of(options),
            seed=options.seed,
            agent_settings=settings[name],
            env_settings=shared.parse_settings(options.env),
            start=shared.parse_settings(options.start),
        )
        for name in names
    ]
    return drive(
        cases, console, frames=options.frames, every=options.every, video=options.video,
        fps=options.fps, speed_up=options.speed_up, colour=options.colour,
    )  # fmt: skip
