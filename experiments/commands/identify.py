"""`lpv-track identify`: a vehicle's parameters from logs of its drives."""

import argparse
import shlex

from rich.console import Console

from experiments.commands.options import EXIT_INTERRUPTED, file_name, number

EXAMPLE = "lpv-track identify drive.csv --vehicle bmw-320i --out my.json"
TOPICS = ("odometry", "imu", "wheel-speed", "fix", "command")
"""Kinds of topics with an option --KIND-topic, which selects one of several in a bag."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "logs", nargs="+", type=file_name, metavar="LOG",
        help="CSV with a header: time, vx, vy, yaw_rate, heading, x, y (those that were measured; "
        "s, m, rad), acceleration_command, steering_command; or a bag",
    )  # fmt: skip
    parser.add_argument(
        "--vehicle", default="m2-minibus", metavar="NAME",
        help="nominal vehicle: preset or .json; its mass, axles and limits are kept",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=file_name, required=True, metavar="JSON",
        help="the identified vehicle; NAME.identification.json and NAME.png are written beside it",
    )  # fmt: skip
    parser.add_argument(
        "--friction", type=number(0.05, 2.0), metavar="MU",
        help="known coefficient of friction, for drives beyond the tyres' linear range "
        "(default: linear tyres, from the parts of the logs with at most 3 m/s^2)",
    )  # fmt: skip
    parser.add_argument(
        "--window", type=number(0.5, 30.0, "s"), default=3.0, metavar="S",
        help="length of the windows that are predicted, s (default 3)",
    )  # fmt: skip
    for kind in TOPICS:
        parser.add_argument(
            f"--{kind}-topic", metavar="TOPIC", help="required if a bag has several"
        )


def run(options: argparse.Namespace, console: Console) -> int:
    """Identify, print tables, write the files; return 0.

    Raises
    ------
    ValueError
        For anything that the user can correct, in one line.
    """
    import math

    from experiments.identification.identify import identify
    from experiments.identification.log import read
    from experiments.identification.report import check_table, summary, table, write
    from experiments.run.engines import Interrupts
    from lpv_track_env import vehicle

    if options.out.suffix != ".json":
        raise ValueError(f"{options.out}: a vehicle is written as NAME.json")
    nominal = vehicle.load(options.vehicle)
    topics = {
        kind: topic
        for kind in TOPICS
        if (topic := getattr(options, f"{kind.replace('-', '_')}_topic")) is not None
    }
    logs = [read(file, topics) for file in options.logs]
    try:
        with console.status("reading") as status, Interrupts() as interrupts:

            def note(text: str) -> None:
                interrupts.check()
                status.update(text)

            found = identify(
                logs, nominal, name=options.out.stem,
                friction=math.inf if options.friction is None else options.friction,
                window=options.window, progress=note,
            )  # fmt: skip
    except KeyboardInterrupt:
        console.print("interrupted: nothing is written")
        return EXIT_INTERRUPTED
    settings = {
        "logs": [str(file) for file in options.logs], "vehicle": options.vehicle,
        "friction": options.friction, "window": options.window,
    }  # fmt: skip
    files = write(found, options.out, settings)
    console.print(table(found))
    console.print(check_table(found.checks))
    console.out(summary(found), highlight=False)
    for remark in found.remarks:
        console.out(f"remark: {remark}", highlight=False)
    console.out(f"written: {', '.join(map(str, files))}", highlight=False)
    drive = f"lpv-track benchmark --agents lpv-nmpc --vehicles {shlex.quote(str(options.out))}"
    if found.conditions:
        pairs = " ".join(f"{key}={value:.4g}" for key, value in found.conditions.items())
        drive += f" --conditions ideal --conditions-set {pairs}"
    console.out(f"drive it: {drive}", highlight=False)
    return 0
