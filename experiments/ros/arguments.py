"""The options of `lpv-track bag`; light, since every command's parser is built at each start."""

import argparse
from pathlib import Path

TOPIC_KINDS = ("odometry", "imu", "wheel-speed", "fix", "command")
"""Kinds of topics of which a bag may have several: each has an option --KIND-topic."""


def add_bag_parsers(bag: argparse.ArgumentParser) -> None:
    """Add `export`, `info`, `reference` and `replay` to the parser of `bag`."""
    actions = bag.add_subparsers(dest="action", required=True, metavar="ACTION")

    def add(name: str, summary: str, example: str) -> argparse.ArgumentParser:
        return actions.add_parser(
            name,
            help=summary,
            description=summary,
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    _export(
        add(
            "export",
            "Drive a trajectory and write the run as a ROS bag.",
            "lpv-track bag export --agent lpv-nmpc --trajectory T2 --out run.bag",
        )
    )
    add(
        "info",
        "List a bag's topics, and what of them can be used here.",
        "lpv-track bag info run.bag",
    ).add_argument("file", type=Path, metavar="FILE")
    _reference(
        add(
            "reference",
            "Make a reference path of a recorded drive, as a CSV file that --trajectory takes.",
            "lpv-track bag reference run.bag --out path.csv",
        )
    )
    _replay(
        add(
            "replay",
            "Feed a drive's sensors to the estimator and an agent, and compare with the recording.",
            "lpv-track bag replay run.bag --trajectory T2 --out results/replay",
        )
    )


def _export(export: argparse.ArgumentParser) -> None:
    export.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    export.add_argument("--trajectory", default="T2", metavar="NAME")
    export.add_argument("--vehicle", default="m2-minibus", metavar="NAME")
    export.add_argument("--speed-mode", default="variable", choices=["variable", "fixed"])
    export.add_argument("--seed", type=int, default=0)
    export.add_argument("--conditions", default="simulation", metavar="NAME", help="of the drive")
    export.add_argument(
        "--sensors", metavar="NAME",
        help="conditions, e.g. realtime, whose errors /imu, /wheel_speed and /fix have (default: "
        "none, the truth); drawn by --seed",
    )  # fmt: skip
    export.add_argument("--agent-set", nargs="+", default=[], metavar="KEY=VALUE")
    export.add_argument("--env", nargs="+", default=[], metavar="KEY=VALUE")
    export.add_argument(
        "--out", type=Path, required=True, metavar="BAG",
        help="NAME.bag for ROS 1, else the folder of a ROS 2 bag",
    )  # fmt: skip
    export.add_argument("--format", choices=["ros1", "ros2"], help="default: by the name of BAG")
    export.add_argument(
        "--storage", default="sqlite3", choices=["sqlite3", "mcap"], help="of a ROS 2 bag"
    )
    _add_datum(export, "where x = y = 0 lies (default 45 10 0)")


def _reference(made: argparse.ArgumentParser) -> None:
    made.add_argument("file", type=Path, metavar="FILE")
    made.add_argument("--out", type=Path, required=True, metavar="CSV")
    made.add_argument(
        "--source", choices=["odometry", "fix"], help="default: odometry, if there is any"
    )
    for kind in ("odometry", "fix"):
        made.add_argument(f"--{kind}-topic", metavar="TOPIC", help="where there are several")
    made.add_argument(
        "--smoothing", type=float, metavar="M",
        help="rms distance of recorded positions from the line, m (default: cross-validated)",
    )  # fmt: skip
    made.add_argument(
        "--speed", default="recorded", choices=["recorded", "planned"],
        help="planned: 10 m/s, 2 m/s^2 laterally, 1.5 m/s^2 along the path, jerk-limited",
    )  # fmt: skip
    _add_datum(made, "of fixes: where x = y = 0 lies (default: the bag's datum, or the first fix)")


def _replay(replay: argparse.ArgumentParser) -> None:
    replay.add_argument("file", type=Path, metavar="FILE")
    replay.add_argument(
        "--trajectory", required=True, metavar="NAME", help="a name, or a file of `bag reference`"
    )
    replay.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    replay.add_argument("--vehicle", default="m2-minibus", metavar="NAME")
    replay.add_argument("--agent-set", nargs="+", default=[], metavar="KEY=VALUE")
    replay.add_argument("--control-period", type=float, default=0.05, metavar="S")
    replay.add_argument("--out", type=Path, default=Path("results/replay"), metavar="DIR")
    for kind in TOPIC_KINDS:
        replay.add_argument(f"--{kind}-topic", metavar="TOPIC", help="where there are several")
    _add_datum(
        replay, "where the path's x = y = 0 lies (default: the path's, the bag's, or the first fix)"
    )


def _add_datum(parser: argparse.ArgumentParser, meaning: str) -> None:
    parser.add_argument(
        "--datum", type=float, nargs=3, metavar=("LAT", "LON", "H"),
        help=f"deg, deg, m: {meaning}",
    )  # fmt: skip
