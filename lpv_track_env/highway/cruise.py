"""Adaptive cruise control: the reference's speed, lowered to keep a gap to who drives ahead.

The Intelligent Driver Model (Treiber, Hennecke, Helbing: Congested traffic states in empirical
observations and microscopic simulations, Phys. Rev. E 62, 2000) without its free-road term, for
that is the path's own speed profile. With speed v, gap g between bumpers and approach rate dv::

    dv/dt = a (1 - (g* / g)^2),    g* = s0 + v T + v dv / (2 sqrt(a b))

It is integrated forward from the vehicle's own speed, with vehicles ahead keeping theirs, over
all that an agent's preview shows. So a controller that looks ahead sees the braking before it is
due.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectories import ReferencePath
from trajectories.table import SPEED, TIME

Array = NDArray[np.float64]

STANDSTILL = 1e-3
"""m/s that stand for a stop: a reference's time would not go on at 0."""
CRAWL = 0.3
"""m/s; slower than this a stop is asked for at once, for a path's cells do not resolve it."""
HELD = 100.0
"""m beyond a profile's end over which its last speed holds."""


class Leader(NamedTuple):
    """A vehicle ahead: gap between the bumpers along the path, m, and its speed along it, m/s."""

    gap: float
    speed: float


@dataclass(frozen=True)
class CruiseControl:
    """Settings of the gap that is kept.

    Parameters
    ----------
    time_gap
        T, s: the gap grows with speed by it.
    standstill_gap
        s0, m, between the bumpers.
    acceleration, deceleration
        a and b, m/s^2, comfortable.
    max_deceleration
        m/s^2, of the reference where it brakes hard.
    range
        m ahead on the path that are watched.
    side_clearance
        m between two bodies side by side under which the other is in the way.
    cut_in_time
        s: who will be in the way within it, keeping its lateral speed, is so already.

    Raises
    ------
    ValueError
        For a setting that is not a positive finite number.
    """

    time_gap: float = 1.5
    standstill_gap: float = 4.0
    acceleration: float = 1.5
    deceleration: float = 2.0
    max_deceleration: float = 4.0
    range: float = 80.0
    side_clearance: float = 0.4
    cut_in_time: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"cruise control: {field.name} must be positive, not {value!r}")

    def response(self, speed: float, leader: Leader) -> float:
        """dv/dt, m/s^2, that a leader asks for; never above `acceleration`."""
        approach = speed - leader.speed
        root = 2.0 * math.sqrt(self.acceleration * self.deceleration)
        wanted = self.standstill_gap + max(speed * self.time_gap + speed * approach / root, 0.0)
        asked = self.acceleration * (1.0 - (wanted / max(leader.gap, 0.1)) ** 2)
        return max(asked, -self.max_deceleration)

    def profile(
        self, arc_length: float, speed: float, leaders: Sequence[Leader], period: float, steps: int
    ) -> tuple[Array, Array]:
        """Arc lengths (steps + 1,), m, and speeds (steps + 1,), m/s, of keeping the gaps.

        Parameters
        ----------
        arc_length, speed
            Where and how fast it begins, m and m/s.
        leaders
            One or more; the one that asks for most counts.
        period
            s between steps.
        steps
            Their number.
        """
        s, v = arc_length, max(speed, 0.0)
        ahead = [s + leader.gap for leader in leaders]
        places, speeds = [s], [v]
        for k in range(steps):
            t = k * period
            asked = min(
                self.response(v, Leader(place + leader.speed * t - s, leader.speed))
                for place, leader in zip(ahead, leaders, strict=True)
            )
            after = max(v + period * asked, 0.0)
            s += 0.5 * period * (v + after)
            v = after
            places.append(s)
            speeds.append(v)
        if speeds[0] < CRAWL and speeds[-1] == 0.0:
            return np.array(places), np.zeros(len(places))
        return np.array(places), np.array(speeds)


def lower_speed(path: ReferencePath, table: Array, arc_length: Array, speed: Array) -> None:
    """Write the path's speeds to `table`, but at most `speed` from where it begins, and the times.

    Beyond the profile's end its last speed holds: a reference that stops there does not start
    again.

    Parameters
    ----------
    path
        Whose `table` is the base, (n, 8).
    table
        (n, 8), written to: its columns SPEED and TIME.
    arc_length, speed
        (m,) m, not decreasing, of a closed path beyond its length where the profile passes the
        seam; (m,) m/s.
    """
    table[:, SPEED] = path.speed
    n, h = len(path.speed), path.spacing
    # The cell in which it begins has both its nodes lowered.
    first = math.floor(arc_length[0] / h) - 1
    last = math.floor((arc_length[-1] + HELD) / h)
    if path.closed:
        nodes = np.arange(first, min(last, first + n - 2) + 1)
    else:
        nodes = np.arange(max(first, 0), min(last, n - 1) + 1)
    lowered = np.interp(nodes * h, arc_length, speed)
    at = nodes % (n - 1) if path.closed else nodes
    table[at, SPEED] = np.clip(lowered, STANDSTILL, path.speed[at])
    if path.closed:
        table[n - 1, SPEED] = table[0, SPEED]
    table[0, TIME] = 0.0
    np.cumsum(2.0 * h / (table[1:, SPEED] + table[:-1, SPEED]), out=table[1:, TIME])
