"""Computing times as delays: measured or recorded, in sequence or in parallel processes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.conditions import LONGEST_DELAY
from trajectories.naming import choose

Array = NDArray[np.float64]

ARRANGEMENTS = ("sequential", "triggered", "free-running")
LEVELS = 65
"""Quantiles by which a distribution is kept."""


def quantiles(times: ArrayLike) -> list[float]:
    """A distribution of times (s) as its quantiles at equal steps, smallest to largest."""
    return [float(q) for q in np.quantile(np.asarray(times), np.linspace(0.0, 1.0, LEVELS))]


class ComputingTimes:
    """What passes between readings and command, period by period: for `rollout`.

    Arrangements of estimator and controller:

    sequential
        One process: the estimate is made, then the command. It takes t_e + t_c, and so long the
        process is busy.
    triggered
        Two processes: each estimate sets the controller off. It takes t_e + t_c and the mailbox;
        busy is the slower of the two.
    free-running
        Two processes with clocks of their own: a command starts from the newest estimate, whose
        age is anything up to a period beyond t_e. So latency has that wait on top.

    Parameters
    ----------
    arrangement
        One of `ARRANGEMENTS`.
    estimation
        Times of the estimator, s: quantiles at equal steps, from the smallest to the largest (one
        number: that time).
    control
        Those of the controller, or "measured": what the agent's `predict` took, here and now, and
        so never twice the same.
    mailbox
        s from one process to another.
    load
        Factor on both times: a slower computer.
    period
        Control period, s.
    seed
        Of the draws.
    """

    def __init__(
        self,
        arrangement: str,
        estimation: Sequence[float] | float,
        control: Sequence[float] | float | str,
        *,
        mailbox: float = 0.0,
        load: float = 1.0,
        period: float,
        seed: int = 0,
    ) -> None:
        self.arrangement = choose("arrangement", arrangement, ARRANGEMENTS)
        if isinstance(control, str) and control != "measured":
            raise ValueError(f"control must be times in s or 'measured', not {control!r}")
        self._control = None if isinstance(control, str) else _checked("control", control)
        self._estimation = _checked("estimation", estimation)
        if not (mailbox >= 0.0 and load > 0.0):
            raise ValueError("mailbox must be >= 0 s, load positive")
        self._mailbox, self._load, self._period = mailbox, load, period
        self._rng = np.random.default_rng([seed, ARRANGEMENTS.index(arrangement)])
        self.latencies: list[float] = []
        """Of every period so far, s."""

    def __call__(self, step: int, seconds: float) -> tuple[float, float]:
        """Latency of a step's command and how long its computation occupies the controller, s."""
        del step
        # The same number of draws whatever the arrangement: only it differs between two runs.
        first, second, wait = self._rng.random(3)
        estimation = self._load * _at(self._estimation, first)
        control = self._load * (seconds if self._control is None else _at(self._control, second))
        latency = estimation + control
        occupied = latency
        if self.arrangement != "sequential":
            latency += self._mailbox
            occupied = max(estimation, control)
        if self.arrangement == "free-running":
            # The newest estimate is up to a period old, or as long as its making takes.
            latency += wait * max(self._period, estimation)
        latency, occupied = min(latency, LONGEST_DELAY), min(occupied, LONGEST_DELAY)
        self.latencies.append(latency)
        return latency, occupied

    def summary(self) -> dict[str, Any]:
        """Median, p99, mean and largest latency, s."""
        values = np.array(self.latencies)
        return {
            "median": float(np.median(values)),
            "mean": float(values.mean()),
            "p99": float(np.percentile(values, 99)),
            "max": float(values.max()),
        }


def _checked(name: str, times: Sequence[float] | float) -> Array:
    values = np.atleast_1d(np.asarray(times, dtype=np.float64))
    if values.size == 0 or not (np.isfinite(values) & (values >= 0.0)).all():
        raise ValueError(f"{name} times must be finite and >= 0 s")
    return np.sort(values)


def _at(levels: Array, share: float) -> float:
    """A distribution's value at a share of its probability."""
    return float(np.interp(share, np.linspace(0.0, 1.0, len(levels)), levels))
