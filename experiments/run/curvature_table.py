"""Errors by the path's curvature: one table a setting, its lines and what a terminal shows."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from rich import box
from rich.table import Table
from rich.text import Text

from experiments.run.band_metrics import BANDS
from experiments.run.tables import Estimate, Result, estimate, label_of, labels

NOTE = (
    "ALE, m, where the path's |curvature| at the foot point is in the band: mean over seeds of the "
    "mean over a seed's drives that came there, ± 95 % interval by the t-distribution over seeds, "
    "since drives of one seed share their disturbances whatever the path. Below it the number of "
    "drives, and the band's share of the time that the agent drove; who leaves the road early sees "
    "less of the path. The largest lateral and the rms heading error by band are in cases.jsonl."
)
DECIMALS = 3


@dataclass(frozen=True)
class Cell:
    """One agent in one band: ALE (m) over the drives that came there, and how long they stayed."""

    ale: Estimate
    drives: int
    share: float
    """Of all time that the agent drove in the setting, 0 to 1."""

    @property
    def error(self) -> str:
        """ALE with its interval."""
        mean = f"{self.ale.mean:.{DECIMALS}f}"
        width = self.ale.half_width
        return mean if width is None else f"{mean} ±{width:.{DECIMALS}f}"

    @property
    def basis(self) -> str:
        """What that is made of."""
        share = f"{100 * self.share:.0f}" if self.share >= 5e-3 else "<1"
        return f"{self.drives} drive{'s' * (self.drives != 1)}, {share} %"


Line = tuple[str, list[Cell | None]]
"""An agent's label, and a cell for each band; None where no drive came there."""


def band_lines(cases: Sequence[Result]) -> list[Line]:
    """Lines of one setting, its agents in the tables' order; none where no case knows bands."""
    lines = []
    for label in labels(cases):
        measured = [
            case
            for case in cases
            if label_of(case) == label
            and any(f"ale_{name}" in case["metrics"] for name in BANDS.names)
        ]
        lines.append((label, [_cell(measured, name) for name in BANDS.names]))
    return lines if any(cell for _, cells in lines for cell in cells) else []


def _cell(measured: Sequence[Result], name: str) -> Cell | None:
    came = [case for case in measured if f"ale_{name}" in case["metrics"]]
    if not came:
        return None
    total = sum(case["metrics"]["duration"] for case in measured)
    stayed = sum(case["metrics"][f"share_{name}"] * case["metrics"]["duration"] for case in came)
    by_seed: dict[int, list[float]] = {}
    for case in came:
        by_seed.setdefault(case["seed"], []).append(case["metrics"][f"ale_{name}"])
    ale = estimate([sum(values) / len(values) for values in by_seed.values()])
    return Cell(ale, len(came), stayed / total if total > 0.0 else 0.0)


def band_ranges() -> list[str]:
    """|curvature| of each band, 1/m, as words."""
    edges = [f"{threshold:g}" for threshold in BANDS.thresholds]
    between = [f"{low} to {high}" for low, high in pairwise(edges)]
    return [f"< {edges[0]}", *between, f"≥ {edges[-1]}"]


def console_curvature(cases: Sequence[Result]) -> Table | None:
    """Table of one setting for a terminal; None where no case knows bands."""
    lines = band_lines(cases)
    if not lines:
        return None
    table = Table(
        title="ALE by curvature, m; drives, share of time", title_justify="left",
        title_style="", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False,
    )  # fmt: skip
    table.add_column("agent", min_width=16, max_width=26, overflow="fold")
    for name, words in zip(BANDS.names, band_ranges(), strict=True):
        table.add_column(f"{name}\n{words} 1/m", justify="right", no_wrap=True)
    for label, cells in lines:
        table.add_row(
            Text(label),
            *(Text(f"{cell.error}\n{cell.basis}" if cell else "–") for cell in cells),
        )
    return table
