"""Tables of one setting with a line per agent over all paths: key figures, errors by curvature."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from experiments.run import published
from experiments.run.metrics import BANDS
from experiments.run.tables import Estimate, Result, by_label, estimate, path_name, violated

KEY_FIGURES = (
    "agent", "whole path", "mean ALE, m", "worst MLE, m", "mean AOE, rad",
    "ALE against published", "median predict, ms", "worst p99, ms", "all constraints kept",
)  # fmt: skip
"""Headings of `key_lines`."""
BAND_NOTE = (
    "ALE (m) where the path's |curvature| at the foot point is in the band: mean over seeds of the "
    "mean over a seed's drives, ± 95 % interval by the t-distribution over seeds, since drives of "
    "one seed share their disturbances whatever the path. Below it, the number of drives that "
    "reached the band and its share of the agent's driving time; an agent that leaves the road "
    "early covers less of the path. The largest lateral and the rms heading error by band are in "
    "cases.jsonl."
)


def over_seeds(cases: Iterable[Result], key: str) -> Estimate:
    """Compute the mean over seeds of a metric's mean over a seed's drives, with its interval.

    Drives of one seed share their disturbances whatever the path.
    """
    by_seed: dict[Any, list[float]] = {}
    for case in cases:
        by_seed.setdefault(case.get("seed"), []).append(float(case["metrics"][key]))
    return estimate([sum(values) / len(values) for values in by_seed.values()])


def with_interval(value: Estimate, decimals: int = 3) -> str:
    """Write a mean and, where there is one, the half width of its interval."""
    mean = f"{value.mean:.{decimals}f}"
    width = value.half_width
    return mean if width is None else f"{mean} ±{width:.{decimals}f}"


def against_published(cases: Iterable[Result]) -> str:
    """Return the mean of our ALE divided by the published one, as a percentage; "–" without any."""
    shares = [
        case["metrics"]["ale"] / row["ale"]
        for case in cases
        if case.get("trajectory") in published.SIMULATION
        and (row := published.row(str(case["trajectory"]), case.get("conditions", "simulation")))
        is not None
    ]
    return f"{100 * np.mean(shares):.1f} %" if shares else "–"


def key_lines(cases: Sequence[Result]) -> list[list[str]]:
    """Return the key figures of one setting's agents, a line of `KEY_FIGURES` for each."""
    lines = []
    for label, group in by_label(cases).items():
        done = [case for case in group if case.get("status") == "ok"]
        finished = sum(case.get("end") == "finished" for case in group)
        line = [label, f"{finished} of {len(group)}"]
        if not done:
            lines.append([*line, *["–"] * (len(KEY_FIGURES) - len(line))])
            continue
        metrics: list[Mapping[str, float]] = [case["metrics"] for case in done]
        worst = max(done, key=lambda case: case["metrics"]["mle"])
        kept = sum(not violated(one) for one in metrics)
        medians = [case["solver"]["median"] for case in done]
        lines.append(
            [
                *line,
                with_interval(over_seeds(done, "ale")),
                f"{worst['metrics']['mle']:.3f} ({path_name(worst.get('trajectory'))})",
                with_interval(over_seeds(done, "aoe")),
                against_published(done),
                f"{1e3 * np.median(medians):.3f}",
                f"{1e3 * max(case['solver']['p99'] for case in done):.2f}",
                f"{kept} of {len(done)}",
            ]
        )
    return lines


@dataclass(frozen=True)
class Cell:
    """ALE (m) of one agent in one band over the drives that came there."""

    ale: Estimate
    drives: int
    share: float
    """Share of all time that the agent drove in the setting, 0 to 1."""

    @property
    def error(self) -> str:
        """ALE with its interval."""
        return with_interval(self.ale)

    @property
    def basis(self) -> str:
        """Number of drives and share of time."""
        share = f"{100 * self.share:.0f}" if self.share >= 5e-3 else "<1"
        return f"{self.drives} drive{'s' * (self.drives != 1)}, {share} %"


Line = tuple[str, list[Cell | None]]
"""An agent's label and a cell for each band, None where no drive came there."""


def band_lines(cases: Sequence[Result]) -> list[Line]:
    """Return a line per agent of one setting; [] where no case has metrics by band."""
    lines = []
    for label, group in by_label(cases).items():
        measured = [
            case for case in group if any(f"ale_{name}" in case["metrics"] for name in BANDS.names)
        ]
        lines.append((label, [_cell(measured, name) for name in BANDS.names]))
    return lines if any(cell for _, cells in lines for cell in cells) else []


def _cell(measured: Sequence[Result], name: str) -> Cell | None:
    came = [case for case in measured if f"ale_{name}" in case["metrics"]]
    if not came:
        return None
    total = sum(case["metrics"]["duration"] for case in measured)
    stayed = sum(case["metrics"][f"share_{name}"] * case["metrics"]["duration"] for case in came)
    share = stayed / total if total > 0.0 else 0.0
    return Cell(over_seeds(came, f"ale_{name}"), len(came), share)


def band_ranges() -> list[str]:
    """Return each band's range of |curvature| in words, 1/m."""
    edges = [f"{threshold:g}" for threshold in BANDS.thresholds]
    between = [f"{low} to {high}" for low, high in pairwise(edges)]
    return [f"< {edges[0]}", *between, f"≥ {edges[-1]}"]
