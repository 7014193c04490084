"""Adaptive cruise control: lower the speed of the reference to keep a gap to the vehicle ahead.

The law is the Intelligent Driver Model (Treiber, Hennecke, Helbing: Congested traffic states in
empirical observations and microscopic simulations, Phys. Rev. E 62, 2000) without its free-road
term, which the path's own speed profile replaces. With speed v, gap g between bumpers and approach
rate dv::

    dv/dt = a (1 - (g* / g)^2),    g* = s0 + v T + v dv / (2 sqrt(a b))

It is integrated forward from the vehicle's present speed over the whole preview of an agent, while
the vehicles ahead keep their speeds. So a predictive controller sees in the preview that it will
have to brake.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectories import ReferencePath
from trajectories.arguments import Number, check_fields
from trajectories.table import SPEED, TIME

Array = NDArray[np.float64]

STANDSTILL = 1e-3
"""Speed of a stopped reference, m/s: at 0 its time would not advance."""
CRAWL = 0.3
"""m/s: a profile that stops from a lower speed stops at once; a path's cells cannot resolve it."""
HELD = 100.0
"""m beyond a profile's end for which its last speed is held."""


class Leader(NamedTuple):
    """A vehicle ahead: gap between the bumpers, m, and its speed, m/s, both along the path."""

    gap: float
    speed: float


RULES = {
    "time_gap": Number(0.0, 100.0, "s", above=True),
    "standstill_gap": Number(0.0, 1000.0, "m", above=True),
    "acceleration": Number(0.0, 1e6, "m/s^2", above=True),
    "deceleration": Number(0.0, 1e6, "m/s^2", above=True),
    "max_deceleration": Number(0.0, 1e6, "m/s^2", above=True),
    "range": Number(0.0, 1e4, "m", above=True),
    "side_clearance": Number(0.0, 100.0, "m", above=True),
    "cut_in_time": Number(0.0, 100.0, "s", above=True),
}


@dataclass(frozen=True)
class CruiseControl:
    """Settings of the gap to the vehicle ahead.

    Parameters
    ----------
    time_gap
        T, s: growth of the gap with speed.
    standstill_gap
        s0, m, between the bumpers.
    acceleration, deceleration
        Comfortable acceleration a and deceleration b, m/s^2.
    max_deceleration
        Largest deceleration of the reference, m/s^2.
    range
        Length of the path ahead that is searched for vehicles, m.
    side_clearance
        Least distance between two bodies side by side, m; a closer one blocks the path.
    cut_in_time
        s: a vehicle that will block the path within this time, at its present lateral speed, blocks
        it already.

    Raises
    ------
    ValueError
        If a setting is not a positive number, or one that no traffic needs.
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
        check_fields(self, RULES, prefix="cruise control: ")

    def response(self, speed: float, leader: Leader) -> float:
        """Compute dv/dt, m/s^2, behind a leader; at most `acceleration`."""
        approach = speed - leader.speed
        root = 2.0 * math.sqrt(self.acceleration * self.deceleration)
        wanted = self.standstill_gap + max(speed * self.time_gap + speed * approach / root, 0.0)
        acceleration = self.acceleration * (1.0 - (wanted / max(leader.gap, 0.1)) ** 2)
        return max(acceleration, -self.max_deceleration)

    def profile(
        self, arc_length: float, speed: float, leaders: Sequence[Leader], period: float, steps: int
    ) -> tuple[Array, Array]:
        """Compute the profile that keeps the gaps: arc lengths and speeds, each (steps + 1,).

        Parameters
        ----------
        arc_length, speed
            Arc length and speed at the start, m and m/s.
        leaders
            One or more vehicles ahead; the one that requires the lowest acceleration counts.
        period
            Time between steps, s.
        steps
            Number of steps.
        """
        s, v = arc_length, max(speed, 0.0)
        ahead = [s + leader.gap for leader in leaders]
        places, speeds = [s], [v]
        for k in range(steps):
            t = k * period
            acceleration = min(
                self.response(v, Leader(place + leader.speed * t - s, leader.speed))
                for place, leader in zip(ahead, leaders, strict=True)
            )
            after = max(v + period * acceleration, 0.0)
            s += 0.5 * period * (v + after)
            v = after
            places.append(s)
            speeds.append(v)
        if speeds[0] < CRAWL and speeds[-1] == 0.0:
            return np.array(places), np.zeros(len(places))
        return np.array(places), np.array(speeds)


def lower_speed(path: ReferencePath, table: Array, arc_length: Array, speed: Array) -> None:
    """Write the path's speeds, lowered to a profile where that is lower, and the times to a table.

    Beyond the profile's end its last speed is held: a reference that stops does not start again.

    Parameters
    ----------
    path
        Path with the original speeds.
    table
        (n, 8): its columns SPEED and TIME are written.
    arc_length, speed
        Profile, (m,) m and (m,) m/s. Arc length does not decrease, and counts on beyond the length
        of a closed path.
    """
    table[:, SPEED] = path.speed
    n, h = len(path.speed), path.spacing
    # Lower both nodes of the cell in which the profile begins.
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
