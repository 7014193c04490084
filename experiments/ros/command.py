"""`lpv-track bag`: export, info, reference, replay."""

import argparse
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.ros.messages import require_rosbags
from experiments.ros.read import BagInfo, info, printable, read
from experiments.ros.reference import reference
from experiments.ros.runs import DATUM, check_datum, topics_of
from experiments.ros.sensors import measured
from experiments.ros.topics import KINDS, SECOND, Topic
from experiments.ros.write import refuse_existing, ros_version, write
from lpv_track_env.conditions import load as load_conditions

Datum = tuple[float, float, float]


def run_bag(options: argparse.Namespace, console: Console) -> int:
    """Run a parsed `lpv-track bag`.

    Raises
    ------
    ModuleNotFoundError
        If `rosbags` is not installed, with what installs it.
    ValueError
        For what the user can mend, in one line.
    """
    require_rosbags()
    if options.action == "export":
        return _export(options, console)
    if options.action == "info":
        return _info(options.file, console)
    if options.action == "reference":
        return _reference(options, console)
    return _replay(options, console)


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _datum(options: argparse.Namespace) -> Datum | None:
    if options.datum is None:
        return None
    latitude, longitude, height = options.datum
    check_datum((latitude, longitude, height))
    return latitude, longitude, height


def _export(options: argparse.Namespace, console: Console) -> int:
    from experiments.commands.options import parse_settings
    from experiments.run.case import Case
    from experiments.run.process import Interrupts
    from experiments.run.rollout import rollout

    # All that can be refused is refused before the drive.
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
        agent_settings=parse_settings(options.agent_set),
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
    _say(
        console,
        f"{case.agent} on {case.trajectory}: {done.end} after {done.trace.time[-1]:.1f} s; "
        f"{messages} messages in {options.out}",
    )
    return 0 if done.end == "finished" else 1


def _info(file: Path, console: Console) -> int:
    bag = info(file)
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
    _say(console, f"{file}: ROS {bag.ros}, {bag.storage}, {seconds:.1f} s")
    console.print(table)
    return 0


def _remarks(bag: BagInfo, topic: str, kind: type[Topic]) -> tuple[str, str]:
    """Rate by header stamps, and what is wrong with a topic's messages."""
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
    from trajectories.files import write as write_path
    from trajectories.importers import IMPORT_LIMITS

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
    write_path(line.path, options.out)
    for message in line.warnings:
        _say(console, f"warning: {message}")
    _say(
        console,
        f"{line.path.length:.1f} m from {line.positions} positions of {line.topic}, which lie "
        f"{line.deviation_rms:.3f} m rms from the smoothed line (largest "
        f"{line.deviation_max:.3f} m): {options.out}",
    )
    return 0


def _replay(options: argparse.Namespace, console: Console) -> int:
    import json

    import gymnasium

    import agents
    import trajectories
    from agents.registry import check_settings
    from experiments.commands.options import parse_settings
    from experiments.ros.arguments import TOPIC_KINDS
    from experiments.ros.comparison import draw, summary, table
    from experiments.ros.recording import record
    from experiments.ros.replay import replay
    from lpv_track_env import vehicle
    from lpv_track_env.estimation.observer import PathObserver
    from trajectories.fileio import write_atomically

    path = trajectories.load(options.trajectory)
    car = vehicle.load(options.vehicle)
    settings = parse_settings(options.agent_set)
    check_settings(options.agent, settings)
    named = {
        kind: topic
        for kind in TOPIC_KINDS
        if (topic := getattr(options, f"{kind.replace('-', '_')}_topic")) is not None
    }
    origin = path.metadata.get("origin")
    datum = _datum(options)
    if datum is None and origin is not None:
        datum = (origin["latitude_deg"], origin["longitude_deg"], origin["height_m"])
    recording = record(options.file, topics=named, datum=datum)
    env = gymnasium.make(
        "lpv_track_env/PathTracking-v0",
        trajectory=path,
        vehicle=car,
        control_period=options.control_period,
    )
    agent = agents.make(options.agent, env, **settings)
    observer = PathObserver(path, env.unwrapped.layout)  # type: ignore[attr-defined]
    done = replay(recording, path, car, agent, observer, control_period=options.control_period)
    found = {
        "format": "lpv-track-replay/1", "bag": str(options.file), "trajectory": path.name,
        "agent": options.agent, "vehicle": car.name, "control_period": options.control_period,
        **summary(done),
    }  # fmt: skip
    file = options.out / "replay.json"
    write_atomically(file, json.dumps(found, indent=1, allow_nan=False).encode())
    draw(done, options.out / "replay.png")
    console.print(table(found))
    for remark in recording.remarks:
        _say(console, f"remark: {remark}")
    _say(console, f"written: {file}, {options.out / 'replay.png'}")
    return 0
