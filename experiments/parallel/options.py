"""Options of `lpv-track run-parallel`."""

import argparse
from pathlib import Path

SETTINGS = (
    "trajectory", "agent", "vehicle", "estimator", "rate", "seconds", "seed",
    "watchdog",
)  # fmt: skip
"""Options that are fields of `Setup` as they stand."""


def add_parallel_options(parser: argparse.ArgumentParser) -> None:
    """Add them to the command's parser."""
    parser.add_argument("--trajectory", default="T2", metavar="NAME")
    parser.add_argument("--agent", default="lpv-nmpc", metavar="NAME", help="or file.py:Class")
    parser.add_argument("--agent-set", nargs="+", default=[], metavar="KEY=VALUE")
    parser.add_argument("--vehicle", default="m2-minibus", metavar="NAME")
    parser.add_argument(
        "--conditions", default="realtime", metavar="NAME", help="realtime, ideal or simulation"
    )
    parser.add_argument("--conditions-set", nargs="+", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--estimator", default="ekf", metavar="NAME", help="ekf, or truth: the true state"
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, metavar="S", help="or until the path ends"
    )
    parser.add_argument("--rate", type=int, default=50, metavar="HZ", help="default 50")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--watchdog", type=int, default=25, metavar="N",
        help="control periods of silence after which a process is taken for hung (default 25)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("results/parallel"), metavar="DIR")
    parser.add_argument(
        "--bench-mailbox", action="store_true",
        help="drive nothing: measure how long a value takes from process to process",
    )  # fmt: skip
