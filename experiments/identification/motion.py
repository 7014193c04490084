"""Motion from a log's readings: for first guesses, and for checks of units and signs."""

import math

import numpy as np
from numpy.typing import NDArray

from experiments.identification.log import Log

Array = NDArray[np.float64]

AGREEING = (0.5, 2.0)
"""Ratios of two readings of the same quantity within which units are taken for right."""
LEAST = 0.3
"""Least correlation at which two readings are compared."""


def smooth_rate(times: Array, values: Array, at: Array) -> Array:
    """Return a reading's rate of change: differences over a fifth of a second."""
    ends = np.clip(np.array([at - 0.1, at + 0.1]), times[0], times[-1])
    early, late = np.interp(ends, times, values)
    return np.asarray((late - early) / np.maximum(ends[1] - ends[0], 1e-9))


def speed(log: Log, at: Array) -> Array:
    """Return the speed, without such readings that of the positions, m/s."""
    if "vx" in log.readings:
        return np.interp(at, *log.readings["vx"])
    rates = [smooth_rate(*log.readings[name], at) for name in ("x", "y")]
    return np.hypot(*rates)


def heading(log: Log, at: Array) -> Array:
    """Return the heading, without such readings the course over ground, rad."""
    if "heading" in log.readings:
        return np.interp(at, *log.readings["heading"])
    if "x" not in log.readings:
        return np.zeros_like(at)
    rates = [smooth_rate(*log.readings[name], at) for name in ("x", "y")]
    return np.unwrap(np.arctan2(rates[1], rates[0]))


def turning(log: Log, at: Array) -> Array:
    """Return the yaw rate, means over a fifth of a second, rad/s."""
    if "yaw_rate" in log.readings:
        times, values = log.readings["yaw_rate"]
        steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)
        return smooth_rate(times, np.concatenate([[0.0], np.cumsum(steps)]), at)
    if "heading" in log.readings:
        return smooth_rate(*log.readings["heading"], at)
    around = np.array([at - 0.2, at + 0.2])
    courses = np.array([heading(log, one) for one in around])
    return np.asarray(np.angle(np.exp(1j * (courses[1] - courses[0]))) / 0.4)


def check(log: Log) -> None:
    """Refuse readings in other units, or with other signs, than those of `log`.

    Raises
    ------
    ValueError
        In one line with the number, and the units that are expected.
    """
    times, commands = log.commands
    largest = float(np.abs(commands[:, 1]).max())
    if largest > 0.5 * math.pi:
        raise ValueError(f"{log.name}: steering up to {largest:.3g} rad; is it in degrees?")
    first, last = log.span
    at = np.arange(first + 0.2, last - 0.2, 0.1)
    pairs = []
    if "yaw_rate" in log.readings and "heading" in log.readings:
        other = smooth_rate(*log.readings["heading"], at)
        words = ("heading changes", "yaw_rate says: are both in rad")
        pairs.append((*words, other, turning(log, at)))
    if "vx" in log.readings and "x" in log.readings:
        rates = [smooth_rate(*log.readings[name], at) for name in ("x", "y")]
        words = ("positions move", "vx says: are they in m and m/s")
        pairs.append((*words, np.hypot(*rates), speed(log, at)))
    for what, than, one, other in pairs:
        ratio = float(np.sqrt(np.mean(one**2)) / max(np.sqrt(np.mean(other**2)), 1e-9))
        alike = float(one @ other) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12)
        if abs(alike) > LEAST and not (alike > 0.0 and AGREEING[0] < ratio < AGREEING[1]):
            sign = "" if alike > 0.0 else "-"
            raise ValueError(f"{log.name}: {what} {sign}{ratio:.3g} times as fast as {than}?")
    steered = commands[np.clip(np.searchsorted(times, at) - 1, 0, None), 1]
    turned = turning(log, at)
    if np.std(steered) > 0.0 and np.std(turned) > 0.0:
        alike = float(np.corrcoef(steered, turned)[0, 1])
        if alike < -LEAST:
            raise ValueError(
                f"{log.name}: turns right where the steering is positive (correlation "
                f"{alike:.2f}); left is positive for both"
            )
