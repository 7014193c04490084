"""Computing times as delays: measured or recorded, of sequential or parallel processes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.conditions import LONGEST_DELAY
from lpv_track_env.task import checked_period
from lpv_track_env.validation import SEED
from trajectories.arguments import Number, array, shown
from trajectories.naming import choose

Array = NDArray[np.float64]

ARRANGEMENTS = ("sequential", "triggered", "free-running")
MAILBOX, LOAD = Number(0.0, 1e6, "s"), Number(0.0, 1e6, above=True)
LEVELS = 65
"""Number of quantiles that represent a distribution."""


def quantiles(times: ArrayLike) -> list[float]:
    """Return the quantiles of times (s) at equal steps, from the smallest to the largest."""
    return [float(q) for q in np.quantile(np.asarray(times), np.linspace(0.0, 1.0, LEVELS))]


class ComputingTimes:
    """Latency from readings to command in every period; an argument of `rollout`.

    With t_e and t_c the times of estimator and controller, the arrangements are:

    sequential
        One process computes the estimate, then the command. Latency and busy time are t_e + t_c.
    triggered
        Two processes; each estimate starts the controller. Latency is t_e + t_c plus the mailbox's
        delay; the slower of the two decides how long the controller is busy.
    free-running
        Two processes with clocks of their own; a command starts from the newest estimate. That is
        up to a period older than t_e, which adds to the latency.

    Parameters
    ----------
    arrangement
        One of `ARRANGEMENTS`.
    estimation
        Times of the estimator, s: a constant, or quantiles at equal steps from the smallest to the
        largest.
    control
        Times of the controller, likewise, or "measured": the duration of the agent's `predict`,
        which differs from run to run.
    mailbox
        Delay from one process to the other, s.
    load
        Factor on both times, for a slower computer.
    period
        Control period, s.
    seed
        Seed of the draws.

    Raises
    ------
    ValueError
        For an unknown arrangement, or times that are negative or not finite.
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
            raise ValueError(f"control must be times in s or 'measured', not {shown(control)}")
        self._control = None if isinstance(control, str) else _checked("control", control)
        self._estimation = _checked("estimation", estimation)
        self._mailbox = MAILBOX.of("mailbox", mailbox)
        self._load = LOAD.of("load", load)
        self._period = checked_period(period)
        seed = SEED.of("seed", seed)
        self._rng = np.random.default_rng([seed, ARRANGEMENTS.index(arrangement)])
        self.latencies: list[float] = []
        """Latency of every period so far, s."""

    def __call__(self, step: int, seconds: float) -> tuple[float, float]:
        """Return the latency of a step's command and the time the controller is busy with it, s."""
        del step
        # The same draws for every arrangement, so that runs differ in the arrangement alone.
        first, second, wait = self._rng.random(3)
        estimation = self._load * _at(self._estimation, first)
        control = self._load * (seconds if self._control is None else _at(self._control, second))
        latency = estimation + control
        occupied = latency
        if self.arrangement != "sequential":
            latency += self._mailbox
            occupied = max(estimation, control)
        if self.arrangement == "free-running":
            # The newest estimate is up to a period old, or as old as its computation is long.
            latency += wait * max(self._period, estimation)
        latency, occupied = min(latency, LONGEST_DELAY), min(occupied, LONGEST_DELAY)
        self.latencies.append(latency)
        return latency, occupied

    def summary(self) -> dict[str, Any]:
        """Return the median, mean, p99 and largest latency, s."""
        values = np.array(self.latencies)
        return {
            "median": float(np.median(values)),
            "mean": float(values.mean()),
            "p99": float(np.percentile(values, 99)),
            "max": float(values.max()),
        }


def _checked(name: str, times: Sequence[float] | float) -> Array:
    values = np.atleast_1d(array(f"{name} times", times))
    if values.ndim > 1 or values.size == 0 or not (np.isfinite(values) & (values >= 0.0)).all():
        raise ValueError(f"{name} times must be finite and >= 0 s")
    return np.sort(values)


def _at(levels: Array, share: float) -> float:
    """Return the quantile of a distribution at a probability."""
    return float(np.interp(share, np.linspace(0.0, 1.0, len(levels)), levels))
