"""`lpv-track excite`: a simulated drive with rich excitation, as a log for `identify`."""

import argparse

from rich.console import Console

from experiments.commands.options import (
    EXIT_INTERRUPTED,
    add_conditions,
    add_control_period,
    add_seed,
    add_settings,
    add_vehicle,
    conditions_of,
    file_name,
    number,
    parse_settings,
)

EXAMPLE = "lpv-track excite --vehicle bmw-320i --env plant=multi-body --out drive.csv"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_vehicle(parser)
    add_settings(parser, "--env", "arguments of the environment, e.g. plant=multi-body")
    add_conditions(parser, changes="fields of the conditions, e.g. steering_lag=0.1")
    parser.add_argument(
        "--seconds", type=number(30.0, 3600.0, "s"), default=180.0, metavar="S",
        help="length of the drive, s (default 180)",
    )  # fmt: skip
    parser.add_argument(
        "--speeds", type=number(1.5, 100.0, "m/s"), nargs=2, default=[6.0, 14.0],
        metavar=("LOW", "HIGH"), help="range of the mean speed, m/s (default 6 14)",
    )  # fmt: skip
    parser.add_argument(
        "--lateral-acceleration", type=number(0.1, 15.0, "m/s^2"), default=2.5, metavar="A",
        help="lateral acceleration that is rarely exceeded, m/s^2 (default 2.5)",
    )  # fmt: skip
    parser.add_argument(
        "--noise", type=number(0.0, 100.0), default=1.0, metavar="FACTOR",
        help="factor on the sensors' noise of 0.03 m, 0.03 m/s (vy 0.05), 0.005 rad, 0.005 rad/s "
        "(default 1)",
    )  # fmt: skip
    add_control_period(parser, 0.02)
    add_seed(parser)
    parser.add_argument("--out", type=file_name, required=True, metavar="CSV")


def run(options: argparse.Namespace, console: Console) -> int:
    """Drive, write the log, and return 0.

    Raises
    ------
    ValueError
        For anything that the user can correct, in one line.
    """
    from experiments.identification.excitation import record
    from experiments.run.case import keyword_settings
    from experiments.run.engines import Interrupts
    from lpv_track_env import vehicle
    from lpv_track_env.env import PathTrackingEnv
    from trajectories.naming import choose

    if options.out.suffix != ".csv":
        raise ValueError(f"{options.out}: a log is written as NAME.csv")
    low, high = options.speeds
    if low > high:
        raise ValueError(f"--speeds: the lower one first, not {low:g} {high:g}")
    car, settings = vehicle.load(options.vehicle), parse_settings(options.env)
    for key in settings:
        choose("environment setting", key, keyword_settings(PathTrackingEnv))
    try:
        with console.status("driving") as status, Interrupts() as interrupts:

            def note(time: float) -> None:
                interrupts.check()
                status.update(f"driving: {time:.0f} of {options.seconds:.0f} s")

            true = record(
                options.out, car, seconds=options.seconds, period=options.control_period,
                speeds=(low, high), lateral_acceleration=options.lateral_acceleration,
                noise=options.noise, seed=options.seed, on_step=note,
                conditions=conditions_of(options), **settings,
            )  # fmt: skip
    except KeyboardInterrupt:
        console.print("interrupted: nothing is written")
        return EXIT_INTERRUPTED
    lateral = abs(true["vx"] * true["yaw_rate"]).max()
    console.out(
        f"{options.seconds:g} s of {car.name}, {true['vx'].min():.1f} to "
        f"{true['vx'].max():.1f} m/s, at most {lateral:.1f} m/s^2 laterally: {options.out}",
        highlight=False,
    )
    return 0
