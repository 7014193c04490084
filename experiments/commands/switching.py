"""`lpv-track switching`: vehicles lost when the NMPC's weights are switched."""

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table

from experiments.commands.options import (
    add_out,
    add_seed,
    add_vehicle,
    file_name,
    resumable,
    whole,
)

if TYPE_CHECKING:
    from agents.weights import TrackingWeights

EXAMPLE = "lpv-track switching --episodes 2000 --spans 10 100 whole --out results/switching"
MOST_SPAN = 1e4


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--episodes", type=whole(1, 10_000_000), default=2000, metavar="N",
        help="of each arm (default 2000)",
    )  # fmt: skip
    parser.add_argument(
        "--spans", nargs="+", default=["10", "100", "1000", "whole"], metavar="FACTOR",
        help="how far weights are drawn from the base ones (default 10 100 1000 whole: the "
        "whole bounds of weights)",
    )  # fmt: skip
    parser.add_argument(
        "--weights", type=file_name, metavar="FILE",
        help="schedule of one set to switch around, as of tune --method search (default: the "
        "default weights)",
    )  # fmt: skip
    parser.add_argument(
        "--candidates", type=whole(1, 10_000), default=4, metavar="K",
        help="draws in every window; the adversary takes the worst of them (default 4)",
    )  # fmt: skip
    parser.add_argument("--conditions", default="realtime", metavar="NAME")
    add_vehicle(parser)
    add_seed(parser)
    parser.add_argument(
        "--threads", type=whole(1, 1024), default=1, metavar="N",
        help="default 1; results do not depend on it",
    )  # fmt: skip
    add_out(parser, "results/switching")


def spans_of(given: list[str]) -> tuple[float, ...]:
    """Convert spans to numbers; "whole" stands for the whole bounds of weights.

    Raises
    ------
    ValueError
        For anything else than a number above 1 and at most 10000.
    """
    from experiments.study.weight_switching import WHOLE

    spans = []
    for text in given:
        try:
            span = WHOLE if text == "whole" else float(text)
        except ValueError:
            span = 0.0
        if span != WHOLE and not 1.0 < span <= MOST_SPAN:
            raise ValueError(
                f"--spans are numbers above 1 and at most {MOST_SPAN:g}, or whole; not {text}"
            )
        spans.append(span)
    return tuple(dict.fromkeys(spans))


def base_of(file: Path | None) -> "TrackingWeights":
    """Return the single set of a schedule's file, or the default set without a file.

    Raises
    ------
    ValueError
        If it cannot be read, or holds a policy or several sets.
    """
    from agents.weight_tuning.policy import load
    from agents.weights import TrackingWeights, WeightSchedule

    if file is None:
        return TrackingWeights()
    result = load(file)
    if not isinstance(result, WeightSchedule) or len(set(result.weights)) != 1:
        raise ValueError(f"{file} holds no single set of weights to switch around")
    return result.weights[0]


def run(options: argparse.Namespace, console: Console) -> int:
    """Drive every arm, print the table and write `switching.json`; arms in it are kept."""
    from agents.weights import HIGHEST, LOWEST
    from experiments.run.benchmark import progress_bar
    from experiments.run.provenance import provenance
    from experiments.study import weight_switching
    from lpv_track_env import conditions
    from lpv_track_env.validation import checked_threads
    from trajectories.fileio import write_atomically

    setup = weight_switching.Setup(
        episodes=options.episodes, conditions=options.conditions, vehicle=options.vehicle,
        candidates=options.candidates, seed=options.seed, weights=base_of(options.weights),
        threads=checked_threads(options.threads),
    )  # fmt: skip
    conditions.load(setup.conditions)
    arms = weight_switching.arms_of(spans_of(options.spans))
    options.out.mkdir(parents=True, exist_ok=True)
    file: Path = options.out / "switching.json"
    # Plain values equal to what JSON gives back, for the comparison with a file.
    plain = json.loads(json.dumps(dataclasses.asdict(setup)))
    del plain["threads"]
    done: dict[str, Any] = {}
    result: dict[str, Any] = {
        "experiment": "switching",
        "setup": plain,
        "window": weight_switching.WINDOW,
        "bounds": [LOWEST, HIGHEST],
        "trajectories": setup.trajectories,
        "sources": _sources(),
        **provenance(),
        "arms": done,
    }
    kept = _kept(file, result)
    batches = -(-setup.episodes // weight_switching.BATCH)
    with resumable(options, console), progress_bar(console) as progress:
        for number, arm in enumerate(arms, start=1):
            if arm.label not in kept:
                bar = progress.add_task(arm.label, total=batches * setup.windows)
                outcome = weight_switching.drive_arm(setup, arm, partial(progress.advance, bar))
                kept[arm.label] = weight_switching.summary(outcome)
            done[arm.label] = {**arm.as_dict(), **kept[arm.label]}
            write_atomically(file, json.dumps(result, indent=1, allow_nan=False).encode())
            if not console.is_terminal:
                console.print(
                    f"[{number}/{len(arms)}] {arm.label}: {done[arm.label]['lost']} lost",
                    markup=False, highlight=False,
                )  # fmt: skip
    console.print(table(result))
    console.print(widest_kept(result))
    console.out(f"written: {file}", highlight=False)
    return 0


def _sources() -> str:
    """Return a digest of the sources that a result depends on."""
    from experiments.run.provenance import project_digest
    from experiments.study import weight_switching

    own = Path(weight_switching.__file__).read_text()
    return hashlib.sha256((project_digest() + own).encode()).hexdigest()[:16]


def _kept(file: Path, result: dict[str, Any]) -> dict[str, Any]:
    """Return the arms of a file written by the same sources and settings; none without one."""
    from trajectories.fileio import checked, read_json

    try:
        content = checked(read_json(file), dict[str, Any], file)
        arms = checked(content.get("arms"), dict[str, dict[str, Any]], file)
    except ValueError:
        return {}
    same = all(content.get(key) == result[key] for key in ("experiment", "setup", "sources"))
    return arms if same else {}


def table(result: Mapping[str, Any]) -> Table:
    """Return a table with a row for each arm."""
    setup = result["setup"]
    shown = Table(
        title=f"Q and S switched every {result['window']:g} s within a span "
        f"around base weights; {setup['conditions']}, {setup['episodes']} episodes a row",
        title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False,
    )  # fmt: skip
    shown.add_column("weights, span", no_wrap=True)
    for heading in (
        "lost", "rate <\n(95 %)", "failed\nsolves", "\nNaN", "rms\nm", "max |e_y|\nmedian",
        "\np99", "\nmax",
    ):  # fmt: skip
        shown.add_column(heading, justify="right", no_wrap=True)
    for label, row in result["arms"].items():
        shown.add_row(
            label, str(row["lost"]), f"{100.0 * row['lost_upper_bound']:.2f} %",
            f"{row['failed_solves']}", str(row["not_finite"]), f"{row['rms_lateral']:.3f}",
            f"{row['largest_lateral_median']:.2f}", f"{row['largest_lateral_p99']:.2f}",
            f"{row['largest_lateral']:.2f}", style="red" if row["lost"] else "",
        )  # fmt: skip
    return shown


def widest_kept(result: Mapping[str, Any]) -> str:
    """Return the widest span of each way to switch in which no vehicle was lost, in words."""
    from experiments.study.weight_switching import CONTROL, WHOLE

    spans: dict[str, list[tuple[float, bool]]] = {}
    for row in result["arms"].values():
        if row["mode"] != CONTROL:
            span = WHOLE if row["span"] is None else row["span"]
            name = f"{row['mode']}, {'no limit' if row['slew'] is None else 'slew limit'}"
            spans.setdefault(name, []).append((span, row["lost"] > 0))
    spans["in every way"] = [row for rows in spans.values() for row in rows]
    words = []
    for name, rows in spans.items():
        lossy = [span for span, lost in rows if lost]
        widest = max((span for span, _ in rows if not lossy or span < min(lossy)), default=None)
        text = "no span" if widest is None else f"span {widest:g}"
        words.append(f"{name}: {'the whole bounds' if widest == WHOLE else text}")
    return "none lost within: " + "; ".join(words)
