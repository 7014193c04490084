"""The command `lpv-track`, same as `python -m experiments`."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

from experiments.options import parser
from experiments.run.engines import one_thread

EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


def run(options: argparse.Namespace) -> int:
    """Run a parsed command; heavy modules load in its runner, after one_thread."""
    from rich.console import Console

    # Piped output keeps the tables' width; a terminal, or COLUMNS, has its own.
    wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 120
    return RUNNERS[options.command](options, Console(width=wide))


def _report(options: argparse.Namespace, console: Any) -> int:
    from experiments.report.build import where, write_report
    from experiments.run.console_tables import console_table
    from experiments.run.store import ResultStore

    if not options.folder.is_dir():
        raise ValueError(f"{options.folder} is not a folder of results")
    report = write_report(options.folder)
    console.print(console_table(ResultStore(options.folder).cases()))
    console.print(where(report), markup=False, highlight=False, soft_wrap=True)
    return 0


def _drive(options: argparse.Namespace, console: Any) -> int:
    from experiments.drive import drive
    from experiments.run.benchmark import parse_settings
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


def _speed(options: argparse.Namespace, console: Any) -> int:
    from experiments.speed.command import run_speed

    _, complete = run_speed(options.out, only=options.only, quick=options.quick, console=console)
    console.print(
        f"{'every round' if complete else 'interrupted; what was measured'}: "
        f"{options.out / 'speed.json'}",
        markup=False, highlight=False, soft_wrap=True,
    )  # fmt: skip
    return 0 if complete else EXIT_INTERRUPTED


def _verify(options: argparse.Namespace, console: Any) -> int:
    from experiments.verify.command import QUICK, SOLVER, verify

    return verify(
        options.out,
        states=QUICK if options.quick else options.states,
        seed=options.seed,
        workers=options.workers,
        solver=options.solver or SOLVER,
        console=console,
    )


def _benchmark(options: argparse.Namespace, console: Any) -> int:
    from experiments.run import suites
    from experiments.run.benchmark import distinct, finish, parse_settings, run_benchmark
    from trajectories.naming import choose

    if options.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, not {options.seeds}")
    names = options.agents or suites.default_agents()
    seeds = range(options.seeds)
    if options.trajectories or options.vehicles or options.speed_modes:
        specs = suites.grid(
            names,
            options.trajectories or suites.SIX,
            vehicles=options.vehicles or ("m2-minibus",),
            speed_modes=options.speed_modes or ("variable",),
            seeds=seeds,
        )
        suite = "custom"
    else:
        suite = choose("suite", options.suite, tuple(suites.SUITES))
        specs = suites.SUITES[suite](names, list(seeds))
    common = {
        "env_settings": parse_settings(options.env),
        "agent_settings": parse_settings(options.agent_set),
        "vehicle_changes": parse_settings(options.vehicle_set),
    }
    if options.control_period is not None:
        common["control_period"] = options.control_period
    if options.conditions is not None or options.conditions_set:
        specs = [{**spec, "conditions": conditions_of(options)} for spec in specs]
    specs = distinct([merged(spec, common) for spec in specs])
    settings = {"suite": suite, "agents": names, "seeds": list(seeds), **common}
    try:
        store = run_benchmark(
            specs, options.out, workers=options.workers, settings=settings,
            resume=options.resume, console=console,
        )  # fmt: skip
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command with --resume goes on from {options.out}")
        return EXIT_INTERRUPTED
    return finish(store, specs, console)


def _realtime(options: argparse.Namespace, console: Any) -> int:
    from experiments.realtime import ablation, latency

    if options.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, not {options.seeds}")
    common: dict[str, Any] = {
        "trajectories": options.trajectories, "seeds": range(options.seeds),
        "workers": options.workers, "console": console,
    }  # fmt: skip
    try:
        if options.command == "ablation":
            return ablation.ablate(options.out, agent=options.agent, **common)
        return latency.compare(options.out, times=options.times, **common)
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command goes on from {options.out}")
        return EXIT_INTERRUPTED


def _switching(options: argparse.Namespace, console: Any) -> int:
    from experiments.robustness.command import run_switching

    try:
        return run_switching(options, console)
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command goes on from {options.out}")
        return EXIT_INTERRUPTED


def _highway(options: argparse.Namespace, console: Any) -> int:
    from experiments.highway.command import run_highway

    try:
        return run_highway(options, console)
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command goes on from {options.out}")
        return EXIT_INTERRUPTED


def conditions_of(options: argparse.Namespace) -> str | dict[str, Any]:
    """Conditions by name, or a dictionary of what departs from them."""
    from experiments.run.benchmark import parse_settings

    changes = parse_settings(options.conditions_set)
    name = options.conditions or "simulation"
    return {"name": name, **changes} if changes else name


def merged(spec: dict[str, object], changes: dict[str, Any]) -> dict[str, object]:
    """A spec with changes: dicts are merged into the spec's own, other values replace them."""
    result = dict(spec)
    for key, value in changes.items():
        own = result.get(key)
        if isinstance(value, dict):
            result[key] = {**(own if isinstance(own, dict) else {}), **value}
        else:
            result[key] = value
    return result


def _trajectories(options: argparse.Namespace, console: Any) -> int:
    import trajectories
    from experiments.run.suites import RAW, SIX
    from experiments.trajectory_figures import draw, rows_table

    names = options.names or [*SIX, *RAW]
    paths = [trajectories.load(name) for name in names]
    console.print(rows_table(paths))
    if options.draw is not None:
        draw(paths if options.names else paths[: len(SIX)], options.draw)
        console.print(f"drawn: {options.draw}", markup=False, soft_wrap=True)
    if options.write is not None:
        from trajectories.files import write

        options.write.mkdir(parents=True, exist_ok=True)
        for path in paths:
            write(path, options.write / f"{path.name}.csv")
        console.print(
            f"{len(paths)} paths written to {options.write}", markup=False, soft_wrap=True
        )
    return 0


def _bag(options: argparse.Namespace, console: Any) -> int:
    from experiments.ros.command import run_bag

    return run_bag(options, console)


def _run_parallel(options: argparse.Namespace, console: Any) -> int:
    from experiments.parallel import command
    from experiments.parallel.options import SETTINGS
    from experiments.parallel.setup import Setup
    from experiments.run.benchmark import parse_settings

    if options.bench_mailbox:
        return command.bench(options.out, console)
    setup = Setup(
        **{name: getattr(options, name) for name in SETTINGS},
        conditions=conditions_of(options),
        agent_settings=parse_settings(options.agent_set),
    )
    return command.run_parallel(setup, options.out, console)


def _train(options: argparse.Namespace, console: Any) -> int:
    from experiments.training.command import run_training

    return run_training(options, console)


def _tune(options: argparse.Namespace, console: Any) -> int:
    from experiments.tuning.command import run_tuning

    return run_tuning(options, console)


def _tuning_study(options: argparse.Namespace, console: Any) -> int:
    from experiments.study.command import run_study

    return run_study(options, console)


def _import_policy(options: argparse.Namespace, console: Any) -> int:
    from experiments.policy_import import run_import

    return run_import(options, console)


RUNNERS: dict[str, Callable[[argparse.Namespace, Any], int]] = {
    "benchmark": _benchmark,
    "report": _report,
    "drive": _drive,
    "trajectories": _trajectories,
    "speed": _speed,
    "ablation": _realtime,
    "latency": _realtime,
    "switching": _switching,
    "highway": _highway,
    "verify": _verify,
    "bag": _bag,
    "run-parallel": _run_parallel,
    "train": _train,
    "tune": _tune,
    "tuning-study": _tuning_study,
    "import-policy": _import_policy,
}
"""What runs each command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point: exit code 2 and one line for what the user can mend."""
    one_thread()
    options = parser().parse_args(arguments)
    try:
        return run(options)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print("lpv-track:", " ".join(str(error).split()), file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
