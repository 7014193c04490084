"""`lpv-track benchmark`: agents x trajectories x seeds, the paper's table, and a report."""

import argparse
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console

from experiments.commands import options as shared

if TYPE_CHECKING:
    from experiments.run.store import ResultStore

EXAMPLE = "lpv-track benchmark --agents stanley lqr --trajectories T1 T2 --out results/mine"
MOST_WARNINGS = 10
"""Different warnings of the drives that are printed."""
MOST_COMPARED = 500
"""Different warnings among which repetitions are looked for."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--suite",
        default="paper",
        help="paper (default), quick, realtime, learned, plants, limits, recovery, converged, "
        "sideslip or frozen",
    )
    shared.add_agents(
        parser, "default: all; your own: file.py:Class, policy.json, or a folder of trainings"
    )
    shared.add_trajectories(parser, None, "instead of a suite's: names or files")
    shared.add_vehicles(parser, None, "presets or .json files")
    shared.add_speed_modes(parser, None)
    shared.add_conditions(
        parser,
        None,
        "simulation (default), realtime, randomised or ideal",
        "fields to change, e.g. gnss_noise=0.3 computing_delay=[0.01,0.05]",
    )
    shared.add_seeds(parser, 1, "seeds 0..N-1 (default 1)")
    shared.add_control_period(parser)
    shared.add_settings(
        parser, "--env", "environment settings, e.g. initial_error_range=[0.3,0.1,0.5]"
    )
    shared.add_start(parser)
    shared.add_agent_settings(parser)
    shared.add_settings(
        parser, "--vehicle-set", "vehicle fields to change, e.g. max_lateral_velocity_ratio=0.5"
    )
    shared.add_out(parser, "results/benchmark")
    shared.add_engine(parser)
    parser.add_argument(
        "--case-limit", type=shared.number(0.0, 1e9, "s", above=True), metavar="S",
        help="a case that takes longer has failed, s (default 1800). With --workers 1 it cannot "
        "end an agent that is stuck in native code",
    )  # fmt: skip
    parser.add_argument(
        "--traces", choices=("all", "drawn", "none"), default="all",
        help="keep traces/ID.npz of all cases (default), of those that a report draws, or of none",
    )  # fmt: skip
    parser.add_argument(
        "--shard", type=_shard, metavar="I/N",
        help="run only every N-th case from the I-th on, for batch systems; each shard has its own "
        "--out, and lpv-track merge joins them",
    )  # fmt: skip
    parser.add_argument(
        "--resume", action="store_true", help="keep the cases that DIR holds already"
    )


def _shard(text: str) -> tuple[int, int]:
    """Read the number of a shard and the number of shards."""
    found = re.fullmatch(r"0*([1-9]\d{0,5})/0*([1-9]\d{0,5})", text, re.ASCII)
    if found is None or int(found[1]) > int(found[2]):
        raise argparse.ArgumentTypeError("must be I/N with 1 <= I <= N, such as 2/8")
    return int(found[1]), int(found[2])


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the cases, print the tables, write the report; return 1 if a case failed, else 0."""
    from experiments.run import suites
    from experiments.run.benchmark import CASE_LIMIT, distinct, run_benchmark, selected, shard
    from experiments.run.case import Case
    from experiments.run.training_folders import expanded, first_training, is_folder
    from trajectories.naming import choose

    seeds = shared.seeds_of(options)
    names = options.agents or suites.default_agents()
    speed_modes = shared.speed_modes_of(options)
    if options.trajectories or options.vehicles or speed_modes:
        specs = suites.grid(
            names,
            options.trajectories or suites.SIX,
            vehicles=options.vehicles or ("m2-minibus",),
            speed_modes=speed_modes or ("variable",),
            grips=options.grip,
            seeds=seeds,
        )
        suite = "custom"
    else:
        suite = choose("suite", options.suite, tuple(suites.SUITES))
        specs = suites.SUITES[suite](names, list(seeds))
    common = {
        "env_settings": shared.parse_settings(options.env),
        "vehicle_changes": shared.parse_settings(options.vehicle_set),
        "start": shared.parse_settings(options.start),
    }
    if options.control_period is not None:
        common["control_period"] = options.control_period
    if options.conditions is not None or options.conditions_set:
        specs = [{**spec, "conditions": shared.conditions_of(options)} for spec in specs]
    own = shared.agent_settings(
        options.agent_set, [spec["agent"] for spec in specs],
        {name: first_training(name)["agent"] for name in names if is_folder(name)},
    )  # fmt: skip
    specs = [merged(spec, {**common, "agent_settings": own[spec["agent"]]}) for spec in specs]
    specs = distinct([one for spec in specs for one in expanded(spec)])
    settings = {
        "suite": suite, "agents": names, "seeds": list(seeds), **common,
        "agent_settings": shared.parse_settings(options.agent_set),
    }  # fmt: skip
    if options.shard is not None:
        specs = shard(specs, *options.shard)
        settings["shard"] = "{}/{}".format(*options.shard)
    if options.env:
        # Refuse values that the environment does not accept before anything is driven.
        Case(**specs[0]).check()
        Case(**specs[0]).make_env().close()
    with shared.resumable(options, console, "the same command with --resume"):
        store = run_benchmark(
            specs, options.out, engine=shared.engine_of(options), settings=settings,
            resume=options.resume, console=console,
            limit=CASE_LIMIT if options.case_limit is None else options.case_limit,
            traces=options.traces,
        )  # fmt: skip
    return finish(store, selected(store, specs), console)


def finish(store: "ResultStore", cases: Sequence[Mapping[str, Any]], console: Console) -> int:
    """Print tables, write the report, say where the rest is; return 1 if a case failed, else 0."""
    from experiments.report.build import where, write_report
    from experiments.report.drives import NamedFiles
    from experiments.run.benchmark import print_failed
    from experiments.run.console_tables import screen

    tables, complete = screen(cases)
    console.print(tables)
    # The files that were just driven with; the folder may name others.
    named = {str(case.get(key)) for case in cases for key in ("trajectory", "vehicle")}
    report = write_report(store.folder, NamedFiles(frozenset(named)))
    every = dict.fromkeys(str(text) for case in cases for text in case.get("warnings", ()))
    texts = list(every)[:MOST_COMPARED]
    # The same warning stands there with and without the name of its file.
    told = [one for one in texts if not any(one != more and more.endswith(one) for more in texts)]
    for text in told[:MOST_WARNINGS]:
        console.out(f"warning: {text}", highlight=False)
    if len(told) > MOST_WARNINGS:
        console.out(f"and {len(told) - MOST_WARNINGS} more warnings in the report", highlight=False)
    failed = print_failed(cases, console)
    lines = [where(report)]
    if not complete:
        lines.append(f"cases: {store.cases_file}; all tables: lpv-track report {store.folder}")
    console.out("\n".join(lines), highlight=False)
    return 1 if failed else 0


def merged(spec: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return a spec with changes: mappings are merged, other values replaced."""
    result = dict(spec)
    for key, value in changes.items():
        own = result.get(key)
        if isinstance(value, dict):
            result[key] = {**(own if isinstance(own, dict) else {}), **value}
        else:
            result[key] = value
    return result
