"""From measures to distributions, and from distributions to a verdict."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Result = Mapping[str, Any]

QUANTILES = {"median": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
SAME = 1e-6
"""Relative difference of cost up to which two plans count as the same optimum."""
LEAST_COMPARED = 0.9
"""Share of the situations for which an oracle must have an answer."""


@dataclass(frozen=True)
class Row:
    """One line of the table: a measure, and what is asked of it.

    Parameters
    ----------
    measure
        Its key in a result's measures.
    title
        For readers.
    goal
        Largest magnitude that is right, or None for information only.
    share
        Least share of the situations within the goal.
    signed
        Whether it is a difference whose sign tells.
    sampled
        Whether only some situations have it.
    """

    measure: str
    title: str
    goal: float | None = None
    share: float = 1.0
    signed: bool = False
    sampled: bool = False


ROWS = (
    Row("states", "roll-out against CasADi", 1e-9),
    Row("A", "dF/dx against CasADi", 1e-9),
    Row("B", "dF/du against CasADi", 1e-9),
    Row("rate", "vx' against CasADi", 1e-9),
    Row("rate_x", "dvx'/dx against CasADi", 1e-9),
    Row("rate_u", "dvx'/du against CasADi", 1e-9),
    Row("qp_first_input", "QP: first input against PIQP", 1e-6),
    Row("qp_plan", "QP: all inputs against PIQP"),
    Row("excess", "plan: hard bounds broken by", 1e-6),
    Row("suboptimality", "plan: IPOPT betters it by", 1e-6, share=0.99),
    Row("cost_error", "plan: cost against IPOPT", signed=True),
    Row("first_input", "plan: first input, same cost", sampled=True),
    Row("fatrop_cost_error", "plan: cost against fatrop", signed=True, sampled=True),
    Row("oracles_cost_error", "fatrop: cost against IPOPT", signed=True, sampled=True),
    Row("one_step_first_input", "one iteration: first input"),
)
"""Errors are magnitudes: entries of derivatives above 1 and costs relative, all others absolute."""


def summarise(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Distribution and verdict of every row.

    Returns
    -------
    list
        One dict a row: measure, title, goal, share_required, compared, of, median, p90, p99, max,
        lower, higher, share_within and holds (None for information). A value that is not finite is
        None. `lower` and `higher` count signed measures beyond `SAME`.
    """
    return [_summary(row, results) for row in ROWS]


def _summary(row: Row, results: Sequence[Result]) -> dict[str, Any]:
    have = [
        result["measures"][row.measure] for result in results if row.measure in result["measures"]
    ]
    values = np.array([value for value in have if value is not None], dtype=np.float64)
    sizes = np.abs(values)
    summary: dict[str, Any] = {
        "measure": row.measure,
        "title": row.title,
        "goal": row.goal,
        "share_required": None if row.goal is None else row.share,
        "compared": len(values),
        "of": len(have) if row.sampled else len(results),
        "lower": int((values < -SAME).sum()) if row.signed else None,
        "higher": int((values > SAME).sum()) if row.signed else None,
    }
    for name, level in QUANTILES.items():
        value = float(np.quantile(sizes, level, method="inverted_cdf")) if len(sizes) else math.inf
        summary[name] = value if math.isfinite(value) else None
    within = None if row.goal is None or not len(sizes) else float((sizes <= row.goal).mean())
    summary["share_within"] = within
    summary["holds"] = None
    if row.goal is not None:
        enough = len(values) >= LEAST_COMPARED * len(results)
        summary["holds"] = bool(enough and within is not None and within >= row.share)
    return summary


def shortfalls(summaries: Sequence[Mapping[str, Any]], results: Sequence[Result]) -> list[str]:
    """One line for each goal that is missed and each situation that could not be measured."""
    lines = []
    for row in summaries:
        if row["holds"] is not False:
            continue
        if row["compared"] < LEAST_COMPARED * row["of"]:
            lines.append(f"{row['title']}: only {row['compared']} of {row['of']} could be compared")
        else:
            lines.append(
                f"{row['title']}: {row['share_within']:.2%} within {row['goal']:g}, "
                f"{row['share_required']:.0%} asked for; largest {number(row['max'])}"
            )
    lines += [f"situation {result['index']}: {result['error']}" for result in results
              if result["error"]]  # fmt: skip
    return lines


def number(value: float | None) -> str:
    """Short form of a measure for the table."""
    return "inf" if value is None else f"{value:.1e}"
