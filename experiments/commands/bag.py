"""`lpv-track bag`: exchange drives with ROS."""

import argparse
import json
from typing import TYPE_CHECKING

from rich.console import Console

from experiments.commands.options import (
    add_agent_settings,
    add_control_period,
    add_out,
    add_seed,
    add_settings,
    add_vehicle,
    agent_settings,
    file_name,
    number,
    parse_settings,
)
from experiments.ros.topics import KINDS, SECOND, Datum, GeoPoint, Topic

if TYPE_CHECKING:
    from experiments.ros.read import BagInfo

EXAMPLE = "lpv-track bag export --trajectory T2 --out run.bag"
ACTIONS = {
    "export": (
        "Drive a trajectory and write the run as a ROS bag.",
        "--agent lpv-nmpc --trajectory T2 --out run.bag",
    ),
    "info": ("List a bag's topics and how they can be used.", "run.bag"),
    "reference": (
        "Make a reference path of a recorded drive, as a CSV file that --trajectory takes.",
        "run.bag --out path.csv",
    ),
    "replay": (
        "Feed a drive's sensors to the estimator and an agent, and compare with the recording.",
        "run.bag --trajectory T2 --out results/replay",
    ),
}
"""Summary and example of each action."""
SELECTED = tuple(kind.KIND for kind in KINDS if kind is not Datum)
"""Kinds of topics with an option --KIND-topic, which selects one of several in a bag."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    declare = {"export": _add_export, "reference": _add_reference, "replay": _add_replay}
    for name, (summary, example) in ACTIONS.items():
        action = actions.add_parser(
            name,
            help=summary,
            description=summary,
            epilog=f"example: lpv-track bag {name} {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name != "export":
            action.add_argument("file", type=file_name, metavar="FILE")
        if name in declare:
            declare[name](action)


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    parser.add_argument("--trajectory", default="T2", metavar="NAME")
    add_vehicle(parser)
    parser.add_argument("--speed-mode", default="variable", choices=["variable", "fixed"])
    add_seed(parser)
    parser.add_argument("--conditions", default="simulation", metavar="NAME", help="of the drive")
    parser.add_argument(
        "--sensors", metavar="NAME",
        help="conditions, e.g. realtime, whose sensor errors are added to /imu, /wheel_speed and "
        "/fix, drawn by --seed (default: none, the true values)",
    )  # fmt: skip
    add_agent_settings(parser)
    add_settings(parser, "--env")
    parser.add_argument(
        "--out", type=file_name, required=True, metavar="BAG",
        help="NAME.bag for ROS 1, else the folder of a ROS 2 bag",
    )  # fmt: skip
    parser.add_argument(
        "--format", choices=["ros1", "ros2"], help="default: according to the name of BAG"
    )
    parser.add_argument(
        "--storage", default="sqlite3", choices=["sqlite3", "mcap"], help="of a ROS 2 bag"
    )
    _add_datum(parser, "position of x = y = 0 (default 45 10 0)")


def _add_reference(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=file_name, required=True, metavar="CSV")
    parser.add_argument(
        "--source", choices=["odometry", "fix"], help="default: odometry, if there is any"
    )
    _add_topics(parser, ("odometry", "fix"))
    parser.add_argument(
        "--smoothing", type=number(0.0, 1e6, "m", above=True), metavar="M",
        help="rms distance of recorded positions from the line, m (default: cross-validated)",
    )  # fmt: skip
    parser.add_argument(
        "--speed", default="recorded", choices=["recorded", "planned"],
        help="planned: 10 m/s, 2 m/s^2 laterally, 1.5 m/s^2 along the path, jerk-limited",
    )  # fmt: skip
    _add_datum(parser, "x = y = 0 for fixes (default: the bag's datum, or the first fix)")


def _add_replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trajectory", required=True, metavar="NAME", help="a name, or a file of `bag reference`"
    )
    parser.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    add_vehicle(parser)
    add_agent_settings(parser)
    add_control_period(parser, 0.05)
    add_out(parser, "results/replay")
    _add_topics(parser, SELECTED)
    _add_datum(parser, "the path's x = y = 0 (default: the path's, the bag's, or the first fix)")


def _add_topics(parser: argparse.ArgumentParser, kinds: tuple[str, ...]) -> None:
    for kind in kinds:
        parser.add_argument(
            f"--{kind}-topic", metavar="TOPIC", help="required if the bag has several"
        )


def _add_datum(parser: argparse.ArgumentParser, meaning: str) -> None:
    parser.add_argument(
        "--datum", type=number(), nargs=3, metavar=("LAT", "LON", "H"),
        help=f"deg, deg, m: {meaning}",
    )  # fmt: skip


def run(options: argparse.Namespace, console: Console) -> int:
    """Run an action and return its exit code.

    Raises
    ------
    ModuleNotFoundError
        If `rosbags` is not installed, with the command that installs it.
    ValueError
        For anything that the user can correct, in one line.
    """
    from experiments.ros.messages import require_rosbags

    require_rosbags()
    action = {"export": _export, "info": _info, "reference": _reference, "replay": _replay}
    return action[options.action](options, console)


def _datum(options: argparse.Namespace) -> GeoPoint | None:
    """Return `--datum`, checked, or None."""
    from experiments.ros.runs import check_datum

    if options.datum is None:
        return None
    latitude, longitude, height = options.datum
    check_datum((latitude, longitude, height))
    return latitude, longitude, height


def _export(options: argparse.Namespace, console: Console) -> int:
    """Drive and write the bag; return 1 if the drive does not finish."""
    from experiments.ros.runs import DATUM, measured, topics_of
    from experiments.ros.write import refuse_existing, ros_version, write
    from experiments.run.case import Case
    from experiments.run.engines import Interrupts
    from experiments.run.rollout import rollout
    from lpv_track_env.conditions import load as load_conditions

    # Everything that can be refused is refused before the drive.
    datum = _datum(options) or DATUM
    sensors = None if options.sensors is None else load_conditions(options.sensors)
    ros_version(options.out, options.format)
    refuse_existing(options.out)
    case = Case(
        agent=options.agent,
        trajectory=options.trajectory,
        vehicle=options.vehicle,
        conditions=options.conditions,
        speed_mode=options.speed_mode,
        seed=options.seed,
        agent_settings=agent_settings(options.agent_set, [options.agent])[options.agent],
        env_settings=parse_settings(options.env),
    )
    case.check()
    env = case.make_env()
    with Interrupts() as interrupts:
        done = rollout(
            env,
            case.make_agent(env),
            seed=case.seed,
            on_step=lambda _step, _info: interrupts.check(),
        )
    topics = topics_of(done.trace, datum=datum)
    if sensors is not None:
        topics = measured(topics, sensors, options.seed)
    write(options.out, topics, bag_format=options.format, storage=options.storage)
    messages = sum(map(len, topics.values()))
    console.out(
        f"{case.agent} on {case.trajectory}: {done.end} after {done.trace.time[-1]:.1f} s; "
        f"{messages} messages in {options.out}",
        highlight=False,
    )
    return 0 if done.end == "finished" else 1


def _info(options: argparse.Namespace, console: Console) -> int:
    """Print a table of the bag's topics and return 0."""
    from rich.markup import escape
    from rich.table import Table

    from experiments.ros.read import info, printable

    bag = info(options.file)
    kinds: dict[str, type[Topic]] = {name: kind for kind in KINDS for name in bag.of_kind(kind)}
    table = Table("topic", "type", "messages", "Hz", "used as", "remarks")
    for topic in bag.topics:
        kind = kinds.get(topic.name)
        rate, remarks = _remarks(bag, topic.name, kind) if kind is not None else ("", "")
        table.add_row(
            *(escape(printable(text)) for text in (topic.name, topic.message_type)),
            str(topic.messages), rate, "" if kind is None else kind.KIND, escape(remarks),
        )  # fmt: skip
    seconds = (bag.end - bag.start) / SECOND
    console.out(f"{options.file}: ROS {bag.ros}, {bag.storage}, {seconds:.1f} s", highlight=False)
    console.print(table)
    return 0


def _remarks(bag: "BagInfo", topic: str, kind: type[Topic]) -> tuple[str, str]:
    """Return the rate by header stamps, and the counts of a topic's faulty messages."""
    from experiments.ros.read import read

    try:
        reading = read(bag.file, kind, topic)
    except ValueError as error:
        return "", str(error).removeprefix(f"{bag.file}: ")
    counts = (
        (reading.out_of_order, "out of order"),
        (reading.duplicates, "duplicate stamps"),
        (reading.unusable, "unusable"),
    )
    remarks = ", ".join(f"{count} {what}" for count, what in counts if count)
    span = float(reading.data.time[-1])
    return (f"{(len(reading.data) - 1) / span:.1f}" if span > 0.0 else ""), remarks


def _reference(options: argparse.Namespace, console: Console) -> int:
    """Write the reference path of a recorded drive and return 0."""
    from experiments.ros.reference import reference
    from trajectories.files import write
    from trajectories.import_options import IMPORT_LIMITS

    if options.out.suffix != ".csv":
        raise ValueError(f"{options.out}: a path is written as NAME.csv")
    source = options.source
    if source is None and options.fix_topic is not None and options.odometry_topic is None:
        source = "fix"
    line = reference(
        options.file,
        source=source,
        topic=options.fix_topic if source == "fix" else options.odometry_topic,
        datum=_datum(options),
        smoothing=options.smoothing,
        limits=IMPORT_LIMITS if options.speed == "planned" else None,
        name=options.out.stem,
    )
    write(line.path, options.out)
    for message in line.warnings:
        console.out(f"warning: {message}", highlight=False)
    console.out(
        f"{line.path.length:.1f} m from {line.positions} positions of {line.topic}, which lie "
        f"{line.deviation_rms:.3f} m rms from the smoothed line (largest "
        f"{line.deviation_max:.3f} m): {options.out}",
        highlight=False,
    )
    return 0


def _replay(options: argparse.Namespace, console: Console) -> int:
    """Replay a recorded drive, write `replay.json` and `replay.png`, print a table, return 0."""
    import gymnasium

    import agents
    import trajectories
    from experiments.ros.comparison import draw, summary, table
    from experiments.ros.replay import record, replay
    from lpv_track_env import PATH_TRACKING, vehicle
    from lpv_track_env.estimation.observer import PathObserver
    from trajectories.fileio import write_atomically

    car = vehicle.load(options.vehicle)
    path = trajectories.load(options.trajectory, vehicle=car)
    settings = agent_settings(options.agent_set, [options.agent])[options.agent]
    named = {
        kind: topic
        for kind in SELECTED
        if (topic := getattr(options, f"{kind.replace('-', '_')}_topic")) is not None
    }
    origin = path.metadata.get("origin")
    datum = _datum(options)
    if datum is None and origin is not None:
        datum = (origin["latitude_deg"], origin["longitude_deg"], origin["height_m"])
    recording = record(options.file, topics=named, datum=datum)
    env = gymnasium.make(
        PATH_TRACKING, trajectory=path, vehicle=car, control_period=options.control_period
    )
    agent = agents.make(options.agent, env, **settings)
    observer = PathObserver(path, env.unwrapped.layout)  # type: ignore[attr-defined]
    done = replay(recording, path, car, agent, observer, control_period=options.control_period)
    found = {
        "format": "lpv-track-replay/1", "bag": str(options.file), "trajectory": path.name,
        "agent": options.agent, "vehicle": car.name, "control_period": options.control_period,
        **summary(done),
    }  # fmt: skip
    file, picture = options.out / "replay.json", options.out / "replay.png"
    write_atomically(file, json.dumps(found, indent=1, allow_nan=False).encode())
    draw(done, picture)
    console.print(table(found))
    for remark in recording.remarks:
        console.out(f"remark: {remark}", highlight=False)
    console.out(f"written: {file}, {picture}", highlight=False)
    return 0
