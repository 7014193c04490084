"""Options of `lpv-track highway`."""

import argparse
import os
from pathlib import Path


def add_highway_options(highway: argparse.ArgumentParser) -> None:
    """Declare the options; highway-env is loaded only where it runs."""
    highway.add_argument(
        "--scene", default="racetrack", metavar="NAME",
        help="racetrack (default), racetrack-large, racetrack-oval, roundabout, "
        "roundabout-generic",
    )  # fmt: skip
    highway.add_argument(
        "--agents", nargs="+", default=["lpv-nmpc", "ppo", "stanley", "idm", "idm-mobil"],
        metavar="NAME",
        help="names of agents, files of policies; idm and idm-mobil are highway-env's own "
        "(default: lpv-nmpc ppo stanley idm idm-mobil)",
    )  # fmt: skip
    highway.add_argument("--seeds", type=int, default=20, metavar="N", help="default 20")
    highway.add_argument(
        "--other-vehicles", type=int, metavar="N",
        help="in the scene's terms: racetracks draw 1 to N (default: highway-env's own, 1)",
    )  # fmt: skip
    highway.add_argument("--laps", type=int, default=1, metavar="N", help="default 1")
    highway.add_argument("--conditions", default="simulation", metavar="NAME")
    highway.add_argument("--control-period", type=float, default=0.05, metavar="S")
    highway.add_argument(
        "--env", nargs="*", default=[], metavar="KEY=VALUE", help="settings of the environment"
    )
    highway.add_argument(
        "--agent-set", nargs="*", default=[], metavar="KEY=VALUE", help="settings of the agents"
    )
    highway.add_argument(
        "--video", type=Path, metavar="FILE",
        help="in place of the table a video, .mp4 or .gif, of the last seed; this project's "
        "agents side by side",
    )  # fmt: skip
    highway.add_argument(
        "--frames", type=Path, metavar="DIR", help="likewise PNG files, one every --every steps"
    )
    highway.add_argument("--every", type=int, default=20, metavar="N", help="default 20")
    highway.add_argument("--out", type=Path, default=Path("results/highway"), metavar="DIR")
    highway.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores"
    )
