"""What came of vehicles whose weights were switched: rates with their bounds, and a table."""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from agents.weight_tuning.score import failed
from experiments.robustness.switching import CONTROL, WHOLE, Outcome
from experiments.run.statistics import rate_bound
from lpv_track_env import kernels as k

Array = NDArray[Any]

BEFORE = 5
"""Windows before a vehicle is lost that are looked at for what lost it: 2 s."""
TUNED_NAMES = tuple(f"{matrix}_{state}" for matrix in "QS" for state in ("vx", "psi", "x", "y"))


def summary(outcome: Outcome) -> dict[str, Any]:
    """What an arm came to, plain values."""
    lost = failed(outcome.ends)
    episodes, failures = len(lost), int(lost.sum())
    ends = Counter(k.END_NAMES[int(end)] for end in outcome.ends)
    kept = outcome.largest[~lost]
    return {
        "episodes": episodes,
        "lost": failures,
        "lost_seeds": outcome.seeds[lost].tolist(),
        "lost_upper_bound": rate_bound(failures, episodes),
        "ends": dict(ends),
        "not_finite": int(outcome.not_finite.sum()),
        "periods": int(outcome.steps.sum()),
        "solves": int(outcome.solves.sum()),
        "failed_solves": int(outcome.failures.sum()),
        "episodes_with_failed_solves": int((outcome.failures > 0).sum()),
        "failed_by_status": dict(outcome.statuses),
        "rms_lateral": math.sqrt(outcome.lateral_square.sum() / max(outcome.steps.sum(), 1.0)),
        "largest_lateral": float(outcome.largest.max()),
        "largest_lateral_not_lost": float(kept.max()) if kept.size else None,
        "largest_lateral_median": float(np.median(outcome.largest)),
        "largest_lateral_p99": float(np.quantile(outcome.largest, 0.99)),
        "weights_before_loss": weights_before_loss(outcome) if failures else None,
    }


def weights_before_loss(outcome: Outcome) -> Mapping[str, Any]:
    """How weights were in the last windows of lost episodes, and otherwise.

    Of log10(weight / base), of its mean over the four weights on position and of differences:
    mean before a loss, mean and standard deviation over all windows.
    """
    lost = failed(outcome.ends)
    decades = outcome.used / np.float32(math.log(10.0))
    driven = np.isfinite(decades[:, :, 0])
    left = driven[:, ::-1].cumsum(axis=1)[:, ::-1]
    before = driven & (left <= BEFORE) & lost[:, None]
    values = {name: decades[:, :, j] for j, name in enumerate(TUNED_NAMES)}
    values["Q_psi - Q_y"] = values["Q_psi"] - values["Q_y"]
    values["S_psi - S_y"] = values["S_psi"] - values["S_y"]
    values["position"] = decades[:, :, [2, 3, 6, 7]].mean(axis=2)
    values["Q_vx - position"] = values["Q_vx"] - values["position"]
    return {
        name: {
            "before_loss": float(value[before].mean()),
            "all": float(value[driven].mean()),
            "spread": float(value[driven].std()),
        }
        for name, value in values.items()
    }


def table(result: Mapping[str, Any]) -> Table:
    """An arm a row."""
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
    """In words, the widest span of each way to switch in which no vehicle was lost."""
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
        said = "no span" if widest is None else f"span {widest:g}"
        words.append(f"{name}: {'the whole bounds' if widest == WHOLE else said}")
    return "none lost within: " + "; ".join(words)
