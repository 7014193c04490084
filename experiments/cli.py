"""The command `lpv-track`, same as `python -m experiments`."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.engines import one_thread
from experiments.parallel.options import SETTINGS
from experiments.parallel.options import add_options as add_parallel_options

EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


def parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    root = argparse.ArgumentParser(
        prog="lpv-track",
        description="Path tracking with a dynamic bicycle: an LPV-NMPC and others, benchmarked.",
        epilog="example: lpv-track benchmark --suite quick --out results/quick",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = root.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, summary: str, example: str) -> argparse.ArgumentParser:
        return commands.add_parser(
            name,
            help=summary,
            description=summary,
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    benchmark = add(
        "benchmark",
        "Run agents x trajectories x seeds, print the paper's table, write report.html.",
        "lpv-track benchmark --agents stanley lqr --trajectories T1 T2 --out results/mine",
    )
    benchmark.add_argument(
        "--suite",
        default="paper",
        help="paper (default), quick, realtime, converged, sideslip or frozen",
    )
    benchmark.add_argument(
        "--agents", nargs="+", metavar="NAME", help="default: all; your own: file.py:Class"
    )
    benchmark.add_argument(
        "--trajectories", nargs="+", metavar="NAME", help="instead of a suite's: names or files"
    )
    benchmark.add_argument("--vehicles", nargs="+", metavar="NAME", help="presets or .json files")
    benchmark.add_argument("--speed-modes", nargs="+", choices=["variable", "fixed"])
    benchmark.add_argument(
        "--conditions", metavar="NAME", help="simulation (default), realtime or ideal"
    )
    benchmark.add_argument(
        "--conditions-set", nargs="+", default=[], metavar="KEY=VALUE",
        help="fields to change, e.g. gnss_noise=0.3 computing_delay=[0.01,0.05]",
    )  # fmt: skip
    benchmark.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="seeds 0..N-1 (default 1)"
    )
    benchmark.add_argument("--control-period", type=float, metavar="S", help="s (default 0.05)")
    benchmark.add_argument(
        "--env", nargs="+", default=[], metavar="KEY=VALUE",
        help="environment settings, e.g. initial_error_range=[0.3,0.1,0.5]",
    )  # fmt: skip
    benchmark.add_argument(
        "--agent-set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of every agent"
    )
    benchmark.add_argument(
        "--vehicle-set", nargs="+", default=[], metavar="KEY=VALUE",
        help="vehicle fields to change, e.g. max_lateral_velocity_ratio=0.5",
    )  # fmt: skip
    benchmark.add_argument("--out", type=Path, default=Path("results/benchmark"), metavar="DIR")
    benchmark.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores"
    )
    benchmark.add_argument(
        "--resume", action="store_true", help="keep the cases that DIR holds already"
    )

    report = add(
        "report",
        "Rebuild the table and report.html from saved cases alone.",
        "lpv-track report results/benchmark",
    )
    report.add_argument("folder", type=Path, metavar="DIR")

    drive = add(
        "drive",
        "Watch one run live, or write its frames.",
        "lpv-track drive --agent lpv-nmpc --trajectory T2 --frames frames --every 4",
    )
    drive.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    drive.add_argument("--trajectory", default="T2", metavar="NAME")
    drive.add_argument("--vehicle", default="m2-minibus", metavar="NAME")
    drive.add_argument("--speed-mode", default="variable", choices=["variable", "fixed"])
    drive.add_argument("--conditions", default="simulation", metavar="NAME")
    drive.add_argument("--conditions-set", nargs="+", default=[], metavar="KEY=VALUE")
    drive.add_argument("--seed", type=int, default=0)
    drive.add_argument("--agent-set", nargs="+", default=[], metavar="KEY=VALUE")
    drive.add_argument("--env", nargs="+", default=[], metavar="KEY=VALUE")
    drive.add_argument(
        "--frames", type=Path, metavar="DIR", help="write PNG frames, open no window"
    )
    drive.add_argument("--every", type=int, default=1, metavar="N", help="a frame every N steps")

    paths = add(
        "trajectories",
        "Print published against achieved rows of the six trajectories and draw them.",
        "lpv-track trajectories --draw trajectories.png --write paths",
    )
    paths.add_argument(
        "names", nargs="*", metavar="NAME", help="default: the six and their raw forms"
    )
    paths.add_argument("--draw", type=Path, metavar="FILE", help="picture, .png or .svg")
    paths.add_argument("--write", type=Path, metavar="DIR", help="write native CSV files")

    speed = add(
        "speed",
        "Measure how fast the environments and the solvers are, against their peers.",
        "lpv-track speed --only single vector --out results/speed",
    )
    speed.add_argument("--out", type=Path, default=Path("results/speed"), metavar="DIR")
    speed.add_argument(
        "--only", nargs="+", default=[], metavar="SECTION",
        help="default: all of single, vector, learning, solvers, horizons, batches, wild, loops, "
        "memory, startup",
    )  # fmt: skip
    speed.add_argument("--quick", action="store_true", help="tiny: shows that it works, no more")

    verify = add(
        "verify",
        "Check the real-time NMPC against independent solvers, models and derivatives.",
        "lpv-track verify --states 200 --out results/verify",
    )
    verify.add_argument("--states", type=int, default=1000, metavar="N", help="default 1000")
    verify.add_argument("--quick", action="store_true", help="24 states, whatever --states says")
    verify.add_argument("--seed", type=int, default=0)
    verify.add_argument(
        "--solver", metavar="MODULE:CLASS", help="default: the real-time solver of lpv-nmpc"
    )
    verify.add_argument("--out", type=Path, default=Path("results/verify"), metavar="DIR")
    verify.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores"
    )

    add_parallel_options(
        add(
            "run-parallel",
            "Drive in real time with estimator and controller as processes of their own.",
            "lpv-track run-parallel --trajectory T2 --seconds 60 --rate 50",
        )
    )
    return root


def run(options: argparse.Namespace) -> int:
    """Run a parsed command; heavy modules load here, after one_thread."""
    from rich.console import Console

    # Piped output keeps the tables' width; a terminal, or COLUMNS, has its own.
    wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 120
    console = Console(width=wide)
    if options.command == "benchmark":
        return _benchmark(options, console)
    if options.command == "report":
        from experiments.report import write_report
        from experiments.results import ResultStore
        from experiments.tables import console_table

        if not options.folder.is_dir():
            raise ValueError(f"{options.folder} is not a folder of results")
        report = write_report(options.folder)
        console.print(console_table(ResultStore(options.folder).cases()))
        console.print(f"report: {report}", markup=False, highlight=False, soft_wrap=True)
        return 0
    if options.command == "drive":
        from experiments.benchmark import parse_settings
        from experiments.cases import Case
        from experiments.drive import drive

        case = Case(
            agent=options.agent,
            trajectory=options.trajectory,
            vehicle=options.vehicle,
            speed_mode=options.speed_mode,
            conditions=conditions_of(options),
            seed=options.seed,
            agent_settings=parse_settings(options.agent_set),
            env_settings=parse_settings(options.env),
        )
        case.check()
        return drive(case, console, frames=options.frames, every=options.every)
    if options.command == "speed":
        from experiments.speed.command import run_speed

        _, complete = run_speed(
            options.out, only=options.only, quick=options.quick, console=console
        )
        console.print(
            f"{'every round' if complete else 'interrupted; what was measured'}: "
            f"{options.out / 'speed.json'}",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
        return 0 if complete else EXIT_INTERRUPTED
    if options.command == "verify":
        from experiments.verify.command import QUICK, SOLVER, verify

        return verify(
            options.out,
            states=QUICK if options.quick else options.states,
            seed=options.seed,
            workers=options.workers,
            solver=options.solver or SOLVER,
            console=console,
        )
    handler = _run_parallel if options.command == "run-parallel" else _trajectories
    return handler(options, console)


def _run_parallel(options: argparse.Namespace, console: object) -> int:
    from rich.console import Console

    from experiments.benchmark import parse_settings
    from experiments.parallel import command
    from experiments.parallel.setup import Setup

    assert isinstance(console, Console)
    if options.bench_mailbox:
        return command.bench(options.out, console)
    settings = {name: getattr(options, name) for name in SETTINGS}
    setup = Setup(
        **settings,
        conditions=conditions_of(options),
        agent_settings=parse_settings(options.agent_set),
    )
    return command.run_parallel(setup, options.out, console)


def _benchmark(options: argparse.Namespace, console: object) -> int:
    from rich.console import Console

    from experiments import suites
    from experiments.benchmark import distinct, finish, parse_settings, run_benchmark
    from lpv_track_env.naming import choose

    assert isinstance(console, Console)
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


def conditions_of(options: argparse.Namespace) -> str | dict[str, Any]:
    """Conditions by name, or a dictionary of what departs from them."""
    from experiments.benchmark import parse_settings

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


def _trajectories(options: argparse.Namespace, console: object) -> int:
    from rich.console import Console

    import trajectories
    from experiments.suites import RAW, SIX
    from experiments.trajectory_figures import draw, rows_table

    assert isinstance(console, Console)
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
