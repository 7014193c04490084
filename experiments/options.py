"""Commands of `lpv-track` and their options."""

import argparse
import os
from collections.abc import Callable
from pathlib import Path

from experiments.highway.options import add_highway_options
from experiments.parallel.options import add_parallel_options
from experiments.ros.arguments import add_bag_parsers
from experiments.training.options import add_training_options
from experiments.tuning.options import add_study_options, add_tuning_options

Add = Callable[[str, str, str], argparse.ArgumentParser]
"""Makes the parser of a command from its name, what it does, and an example."""


def _benchmark(add: Add) -> None:
    benchmark = add(
        "benchmark",
        "Run agents x trajectories x seeds, print the paper's table, write report.html.",
        "lpv-track benchmark --agents stanley lqr --trajectories T1 T2 --out results/mine",
    )
    benchmark.add_argument(
        "--suite",
        default="paper",
        help="paper (default), quick, realtime, learned, plants, converged, sideslip or frozen",
    )
    benchmark.add_argument(
        "--agents",
        nargs="+",
        metavar="NAME",
        help="default: all; your own: file.py:Class, policy.json",
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


def _report(add: Add) -> None:
    report = add(
        "report",
        "Rebuild the table and report.html from saved cases alone.",
        "lpv-track report results/benchmark",
    )
    report.add_argument("folder", type=Path, metavar="DIR")


def _drive(add: Add) -> None:
    drive = add(
        "drive",
        "Watch a run live, or write its frames or a video; several agents side by side.",
        "lpv-track drive --agents lpv-nmpc pure-pursuit --trajectory T2 --video out.mp4",
    )
    drive.add_argument("--agent", metavar="NAME", help="default: lpv-nmpc")
    drive.add_argument(
        "--agents", nargs="+", metavar="NAME", help="drive the same case, side by side"
    )
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
    drive.add_argument(
        "--video", type=Path, metavar="FILE",
        help="write a video, .mp4 or .gif; needs pip install 'lpv-track-env[video]'",
    )  # fmt: skip
    drive.add_argument(
        "--fps", type=float, metavar="N",
        help="frames a second of the video (default: one a control period, at most 50)",
    )  # fmt: skip
    drive.add_argument(
        "--speed-up", type=float, default=1.0, metavar="X",
        help="how many times faster than real time the video runs (default 1)",
    )  # fmt: skip
    drive.add_argument(
        "--colour", default="speed", metavar="WHAT",
        help="of the path: speed (default) or curvature",
    )  # fmt: skip


def _paths(add: Add) -> None:
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


def _speed(add: Add) -> None:
    speed = add(
        "speed",
        "Measure how fast the environments and the solvers are, against their peers.",
        "lpv-track speed --only single vector --out results/speed",
    )
    speed.add_argument("--out", type=Path, default=Path("results/speed"), metavar="DIR")
    speed.add_argument(
        "--only", nargs="+", default=[], metavar="SECTION",
        help="default: all of single, vector, conditions, learning, training, solvers, policies, "
        "horizons, batches, wild, loops, tuning, rendering, memory, startup",
    )  # fmt: skip
    speed.add_argument("--quick", action="store_true", help="tiny: shows that it works, no more")


def _ablation(add: Add) -> None:
    ablation = add(
        "ablation",
        "Drive with each disturbance of a real vehicle alone, with and without compensation.",
        "lpv-track ablation --trajectories T2 T5 --seeds 10 --out results/ablation",
    )
    ablation.add_argument("--agent", default="lpv-nmpc", metavar="NAME")
    ablation.add_argument("--trajectories", nargs="+", default=["T2", "T5"], metavar="NAME")
    ablation.add_argument("--seeds", type=int, default=10, metavar="N", help="default 10")
    ablation.add_argument("--out", type=Path, default=Path("results/ablation"), metavar="DIR")
    ablation.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores"
    )


def _latency(add: Add) -> None:
    latency = add(
        "latency",
        "Compare estimation and control in sequence with both in parallel, times being delays.",
        "lpv-track latency --trajectories T2 T4 --seeds 10 --out results/latency",
    )
    latency.add_argument("--trajectories", nargs="+", default=["T2", "T4"], metavar="NAME")
    latency.add_argument("--seeds", type=int, default=10, metavar="N", help="default 10")
    latency.add_argument(
        "--times", type=Path, metavar="FILE", help="recorded times of a run before: times.json"
    )
    latency.add_argument("--out", type=Path, default=Path("results/latency"), metavar="DIR")
    latency.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores"
    )


def _switching(add: Add) -> None:
    switching = add(
        "switching",
        "Switch the NMPC's weights at random and by an adversary: are vehicles lost?",
        "lpv-track switching --episodes 2000 --spans 10 100 whole --out results/switching",
    )
    switching.add_argument(
        "--episodes", type=int, default=2000, metavar="N", help="of each arm (default 2000)"
    )
    switching.add_argument(
        "--spans", nargs="+", default=["10", "100", "1000", "whole"], metavar="FACTOR",
        help="how far weights are drawn from the base ones (default 10 100 1000 whole: the "
        "whole bounds of weights)",
    )  # fmt: skip
    switching.add_argument(
        "--weights", type=Path, metavar="FILE",
        help="schedule of one set to switch around, as of tune --method search (default: the "
        "default weights)",
    )  # fmt: skip
    switching.add_argument(
        "--candidates", type=int, default=4, metavar="K",
        help="draws in every window of which the adversary takes the worst (default 4)",
    )  # fmt: skip
    switching.add_argument("--conditions", default="realtime", metavar="NAME")
    switching.add_argument("--vehicle", default="m2-minibus", metavar="NAME")
    switching.add_argument("--seed", type=int, default=0)
    switching.add_argument(
        "--threads", type=int, default=1, metavar="N", help="default 1; results do not depend on it"
    )
    switching.add_argument("--out", type=Path, default=Path("results/switching"), metavar="DIR")


def _highway(add: Add) -> None:
    add_highway_options(
        add(
            "highway",
            "Drive laps among highway-env's traffic, beside its own controllers.",
            "lpv-track highway --scene racetrack --agents lpv-nmpc ppo idm --seeds 20",
        )
    )


def _verify(add: Add) -> None:
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


def _bag(add: Add) -> None:
    add_bag_parsers(
        add(
            "bag",
            "Exchange drives with ROS: export, info, reference, replay.",
            "lpv-track bag export --trajectory T2 --out run.bag",
        )
    )


def _run_parallel(add: Add) -> None:
    add_parallel_options(
        add(
            "run-parallel",
            "Drive in real time with estimator and controller as processes of their own.",
            "lpv-track run-parallel --trajectory T2 --seconds 60 --rate 50",
        )
    )


def _train(add: Add) -> None:
    add_training_options(
        add(
            "train",
            "Train a policy that drives, on random paths under randomised conditions.",
            "lpv-track train ppo --seed 0 --hours 0.1 --out results/ppo",
        )
    )


def _tune(add: Add) -> None:
    add_tuning_options(
        add(
            "tune",
            "Tune the NMPC's weights Q and S, on random paths under randomised conditions.",
            "lpv-track tune --method rl --seed 0 --out results/tune/rl",
        )
    )


def _tuning_study(add: Add) -> None:
    add_study_options(
        add(
            "tuning-study",
            "Compare the ways to weights: the whole ladder, held-out paths, oracles, one report.",
            "lpv-track tuning-study --seeds 10 --out results/tuning-study",
        )
    )


def _import_policy(add: Add) -> None:
    command = add(
        "import-policy",
        "Take the policy out of a model that Stable-Baselines3 has saved. The model must have been "
        "trained on lpv_track_env/PathTracking-v0, observations as they come, actions in SI units "
        "or behind gymnasium.wrappers.RescaleAction(env, -1, 1).",
        "lpv-track import-policy model.zip --algorithm ppo --trust --out mine.json",
    )
    command.add_argument("model", type=Path, metavar="MODEL.zip", help="what model.save() wrote")
    command.add_argument("--algorithm", required=True, choices=["ppo", "sac", "td3"])
    command.add_argument(
        "--trust", action="store_true",
        help="load it, although loading such a file runs whatever code it holds",
    )  # fmt: skip
    command.add_argument("--out", type=Path, required=True, metavar="NAME.json")
    command.add_argument(
        "--vehicle", default="m2-minibus", metavar="NAME", help="driven in training"
    )
    command.add_argument("--control-period", type=float, default=0.05, metavar="S")
    command.add_argument("--preview-steps", type=int, default=20, metavar="K")
    command.add_argument(
        "--preview-period", type=float, metavar="S", help="default: the control period"
    )


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

    for declare in (
        _benchmark,
        _report,
        _drive,
        _paths,
        _speed,
        _ablation,
        _latency,
        _switching,
        _highway,
        _verify,
        _bag,
        _run_parallel,
        _train,
        _tune,
        _tuning_study,
        _import_policy,
    ):
        declare(add)
    return root
