"""`lpv-track highway`: drives over seeds, a table, and the results on disk."""

import argparse
import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from agents.registry import check_settings
from experiments.commands.options import parse_settings
from experiments.highway.drives import OWN, TrafficDrive, run_drive
from experiments.run.benchmark import progress_bar
from experiments.run.engines import local_pool
from experiments.run.statistics import rate_interval
from experiments.run.store import ResultStore
from lpv_track_env import conditions
from lpv_track_env.highway import scenes
from lpv_track_env.highway.env import HighwayTrackEnv
from trajectories.naming import choose

ENV_SETTINGS = tuple(
    parameter.name
    for parameter in inspect.signature(HighwayTrackEnv).parameters.values()
    if parameter.kind is parameter.KEYWORD_ONLY
)

Result = Mapping[str, Any]


def run_highway(options: argparse.Namespace, console: Console) -> int:
    """TrafficDrive every agent on every seed, print the table; drives that are there are kept.

    Raises
    ------
    ValueError
        For unknown names or settings, or numbers out of range.
    """
    if options.seeds < 1:
        raise ValueError(f"--seeds must be at least 1, not {options.seeds}")
    choose("scene", options.scene, tuple(scenes.SCENES))
    conditions.load(options.conditions)
    agent_settings = parse_settings(options.agent_set)
    for agent in options.agents:
        if agent not in OWN:
            check_settings(agent, agent_settings)
    env_settings: dict[str, Any] = {"laps": options.laps, **parse_settings(options.env)}
    for key in env_settings:
        choose("environment setting", key, ENV_SETTINGS)
    if options.other_vehicles is not None:
        env_settings["other_vehicles"] = options.other_vehicles
    drives = [
        TrafficDrive(
            agent=agent, scene=options.scene, seed=seed, conditions=options.conditions,
            control_period=options.control_period, env_settings=env_settings,
            agent_settings={} if agent in OWN else agent_settings,
        )
        for agent in options.agents
        for seed in range(options.seeds)
    ]  # fmt: skip
    if options.video is not None or options.frames is not None:
        from experiments.drive import drive

        last = [one for one in drives if one.seed == options.seeds - 1]
        return drive(
            [one for one in last if one.agent not in OWN] or last[:1], console,
            video=options.video, frames=options.frames, every=options.every,
        )  # fmt: skip
    # What cannot be made is told once, before anything is driven.
    drives[0].make_env().close()
    store = ResultStore(options.out)
    store.write_manifest({"experiment": "highway", "drives": len(drives)})
    wanted = {drive.id: drive for drive in drives}
    kept = {case["id"] for case in store.cases() if case["status"] == "ok"}
    left = [vars(drive) for name, drive in wanted.items() if name not in kept]
    with progress_bar(console) as progress:
        bar = progress.add_task("drives", total=len(drives), completed=len(drives) - len(left))
        for result in local_pool(left, options.workers, run_drive, died=_died):
            store.append(result)
            progress.advance(bar)
    results = [case for case in store.cases() if case["id"] in wanted]
    console.print(table(options.agents, results))
    for case in results:
        if case["status"] != "ok":
            console.print(
                f"failed: {case['agent']}, seed {case['seed']}: {case['error']}",
                markup=False, highlight=False,
            )  # fmt: skip
    console.print(f"written: {store.cases_file}", markup=False, highlight=False, soft_wrap=True)
    return 0 if all(case["status"] == "ok" for case in results) else 1


def _died(spec: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": TrafficDrive(**spec).id, **spec, "status": "failed", "end": None, "metrics": {},
        "others": None, "error": "the worker process died, twice", "seconds": 0.0,
    }  # fmt: skip


def table(names: Iterable[str], results: Sequence[Result]) -> Table:
    """Agents, how their drives ended, and how they drove."""
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
    return float(np.sqrt(np.mean(np.square(values))))
