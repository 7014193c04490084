"""`lpv-track highway`: agents in highway-env's traffic, beside its own controllers."""

import argparse
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from experiments.commands import options as shared

EXAMPLE = "lpv-track highway --scene racetrack --agents lpv-nmpc ppo idm --seeds 20"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--scene", default="racetrack", metavar="NAME",
        help="racetrack (default), racetrack-large, racetrack-oval, roundabout, "
        "roundabout-generic",
    )  # fmt: skip
    shared.add_agents(
        parser,
        "names of agents, files of policies; idm and idm-mobil are highway-env's own "
        "(default: lpv-nmpc ppo stanley idm idm-mobil)",
        ["lpv-nmpc", "ppo", "stanley", "idm", "idm-mobil"],
    )
    shared.add_seeds(parser, 20)
    parser.add_argument(
        "--other-vehicles", type=shared.whole(0, 1000), metavar="N",
        help="in the scene's terms: racetracks draw 1 to N (default: highway-env's own, 1)",
    )  # fmt: skip
    parser.add_argument(
        "--laps", type=shared.whole(1, 1000), default=1, metavar="N", help="default 1"
    )
    parser.add_argument("--conditions", default="simulation", metavar="NAME")
    shared.add_control_period(parser, 0.05)
    shared.add_settings(parser, "--env", "settings of the environment", nargs="*")
    shared.add_agent_settings(parser, nargs="*")
    parser.add_argument(
        "--video", type=shared.file_name, metavar="FILE",
        help="in place of the table a video, .mp4 or .gif, of the last seed; this project's "
        "agents side by side",
    )  # fmt: skip
    parser.add_argument(
        "--frames",
        type=shared.file_name,
        metavar="DIR",
        help="likewise PNG files, one every --every steps",
    )
    parser.add_argument(
        "--every", type=shared.whole(1, 10**9), default=20, metavar="N", help="default 20"
    )
    shared.add_out(parser, "results/highway")
    shared.add_engine(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Drive every agent on every seed and print the table; drives of earlier runs are kept.

    Raises
    ------
    ValueError
        For unknown names or settings, or numbers out of range.
    """
    from experiments.run.benchmark import print_failed, run_benchmark, selected
    from experiments.run.case import keyword_settings
    from experiments.run.traffic import OWN, TrafficCase
    from lpv_track_env import conditions
    from lpv_track_env.highway import scenes
    from lpv_track_env.highway.env import HighwayTrackEnv
    from trajectories.naming import choose

    seeds = shared.seeds_of(options)
    choose("scene", options.scene, tuple(scenes.SCENES))
    conditions.load(options.conditions)
    own = shared.agent_settings(
        options.agent_set, [name for name in options.agents if name not in OWN]
    )
    env_settings: dict[str, Any] = {"laps": options.laps, **shared.parse_settings(options.env)}
    for key in env_settings:
        choose("environment setting", key, keyword_settings(HighwayTrackEnv))
    if options.other_vehicles is not None:
        env_settings["other_vehicles"] = options.other_vehicles
    specs = [
        {
            "agent": name, "scene": options.scene, "seed": seed, "conditions": options.conditions,
            "control_period": options.control_period, "env_settings": env_settings,
            "agent_settings": own.get(name, {}),
        }
        for name in options.agents
        for seed in seeds
    ]  # fmt: skip
    if options.video is not None or options.frames is not None:
        from experiments.drive import drive

        shown = [
            TrafficCase(**spec)
            for spec in specs
            if spec["seed"] == seeds[-1] and spec["agent"] not in OWN
        ]
        if not shown:
            raise ValueError("highway-env's own controllers have no picture here: name an agent")
        return drive(
            shown, console, video=options.video, frames=options.frames, every=options.every
        )
    for spec in specs:
        TrafficCase(**spec).check()
    # Refuse settings that the environment does not accept before anything is driven.
    TrafficCase(**specs[0]).make_env().close()
    with shared.resumable(options, console):
        store = run_benchmark(
            specs, options.out, engine=shared.engine_of(options), console=console, kind=TrafficCase,
            settings={"experiment": "highway", "drives": len(specs)},
        )  # fmt: skip
    results = selected(store, specs, TrafficCase)
    console.print(table(options.agents, results))
    failed = print_failed(results, console)
    console.out(f"written: {store.cases_file}", highlight=False)
    return 1 if failed else 0


def table(names: Iterable[str], results: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table with a row per agent: ends of its drives, errors, gaps, speed, times."""
    import numpy as np

    from experiments.run.statistics import rate_interval

    shown = Table(
        title="In highway-env's traffic (collisions: how many, and 95 % bound of their rate)",
        title_justify="left",
    )
    shown.add_column("agent")
    for heading in (
        "finished", "collisions", "other ends", "rms to path, m", "worst rms, m",
        "rms to lane, m",
        "least gap, m", "speed, m/s", "predict, ms",
    ):  # fmt: skip
        shown.add_column(heading, justify="right")
    for name in names:
        done = [case for case in results if case["agent"] == name and case["status"] == "ok"]
        if not done:
            continue
        ends = [case["end"] for case in done]
        finished, hit = ends.count("finished"), ends.count("collision")
        _, high = rate_interval(hit, len(done))
        metrics = [case["metrics"] for case in done]
        gaps = [one["least_gap"] for one in metrics if "least_gap" in one]
        times = [one["predict_median"] for one in metrics if "predict_median" in one]
        shown.add_row(
            name,
            f"{finished} of {len(done)}",
            f"{hit} (<{100 * high:.0f}%)",
            _others(ends),
            f"{_rms([one['lateral_rms'] for one in metrics]):.3f}",
            f"{max(one['lateral_rms'] for one in metrics):.3f}",
            f"{_rms([one['lane_rms'] for one in metrics]):.3f}",
            f"{min(gaps):.1f}" if gaps else "–",
            f"{np.mean([one['mean_speed'] for one in metrics]):.1f}",
            f"{1e3 * np.median(times):.3f}" if times else "–",
        )
    return shown


def _others(ends: Sequence[str]) -> str:
    rest = sorted(set(ends) - {"finished", "collision"})
    return ", ".join(f"{ends.count(end)} {end}" for end in rest) or "–"


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))
