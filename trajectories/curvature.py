"""Curvature of waypoints, statistics of a path, and bands of curvature."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories.arguments import Number, check_fields, instance_of, numbers, shown
from trajectories.path import ReferencePath

Array = NDArray[np.float64]


def waypoint_curvature(x: ArrayLike, y: ArrayLike) -> Array:
    """Unsigned curvature |x'y'' - y'x''| / (x'^2 + y'^2)^(3/2) of waypoints, (n,) -> (n,), 1/m.

    The formula of kumar2025lpv, evaluated as the paper's figures suggest: central differences,
    taken twice. At a kink of angle D between waypoints a distance d apart it gives
    sin(D/2) / (d cos^2(D/2)) at the kink and sin(D) / (4 d) at both neighbours.
    """
    return np.abs(signed_waypoint_curvature(x, y))


def signed_waypoint_curvature(x: ArrayLike, y: ArrayLike) -> Array:
    """`waypoint_curvature` with its sign, positive to the left."""
    dx, dy = np.gradient(np.asarray(x, dtype=np.float64)), np.gradient(np.asarray(y, dtype=float))
    ddx, ddy = np.gradient(dx), np.gradient(dy)
    curvature: Array = (dx * ddy - dy * ddx) / (dx * dx + dy * dy) ** 1.5
    return curvature


def circle_curvature(x: ArrayLike, y: ArrayLike) -> Array:
    """Signed curvature of the circle through each point and its neighbours (Menger), (n,), 1/m.

    4 area / (product of the sides); both ends repeat the value beside them.
    """
    points = np.column_stack([np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)])
    before, after = points[1:-1] - points[:-2], points[2:] - points[1:-1]
    across = points[2:] - points[:-2]
    doubled = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    sides = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    inner = 2.0 * doubled / np.maximum(sides * np.linalg.norm(across, axis=1), 1e-12)
    return np.concatenate([inner[:1], inner, inner[-1:]])


@dataclass(frozen=True)
class PathStatistics:
    """The rows of the paper's trajectory table, in SI units."""

    max_speed: float
    max_acceleration: float
    max_lateral_acceleration: float
    length: float
    max_curvature: float
    total_curvature: float


def statistics(path: ReferencePath) -> PathStatistics:
    """Compute the rows of the paper's trajectory table for a path.

    Total curvature is the literal sum of |kappa_i| over waypoints 0.25 m apart (see the project's
    errata); the last waypoint of a closed path, which repeats the first, does not count.
    """
    instance_of("path", path, ReferencePath, "a ReferencePath")
    curvature = np.abs(path.curvature)
    once = curvature[:-1] if path.closed else curvature
    return PathStatistics(
        max_speed=float(path.speed.max()),
        max_acceleration=float(path.acceleration.max()),
        max_lateral_acceleration=float((path.speed**2 * curvature).max()),
        length=path.length,
        max_curvature=float(curvature.max()),
        total_curvature=float(once.sum()),
    )


@dataclass(frozen=True)
class CurvatureBands:
    """Bands of |kappa|: band k lies between thresholds k - 1 and k.

    Parameters
    ----------
    thresholds
        Increasing, 1/m. The defaults 0.005, 0.02 and 0.05 take 1.1, 4.6 and 11.3 degrees of
        steering at a wheelbase of 4 m.
    names
        Names of the bands, one more than thresholds.
    hysteresis
        Share of a threshold by which |kappa| must fall below it before a lower band is selected.

    Raises
    ------
    ValueError
        If thresholds do not increase from above 0, or there are too few or too many names.
    """

    thresholds: tuple[float, ...] = (0.005, 0.02, 0.05)
    names: tuple[str, ...] = ("straight", "gentle", "moderate", "sharp")
    hysteresis: float = 0.2

    def __post_init__(self) -> None:
        for name in ("thresholds", "names"):
            value = getattr(self, name)
            object.__setattr__(self, name, tuple(instance_of(name, value, list | tuple, "a list")))
        thresholds = numbers("thresholds", self.thresholds, Number(), len(self.thresholds))
        object.__setattr__(self, "thresholds", thresholds)
        if not all(b > a for a, b in pairwise((0.0, *thresholds))):
            raise ValueError(f"thresholds must increase from above 0: {shown(thresholds)}")
        if len(self.names) != len(thresholds) + 1:
            raise ValueError(f"{len(thresholds)} thresholds need {len(thresholds) + 1} names")
        for name in self.names:
            instance_of("a name of a band", name, str, "a text")
        check_fields(self, {"hysteresis": Number(0.0, math.nextafter(1.0, 0.0))})

    def __len__(self) -> int:
        return len(self.names)

    def classify(self, curvature: ArrayLike) -> NDArray[np.intp]:
        """Band index of each |curvature| (1/m), shaped like the input, without hysteresis."""
        return np.searchsorted(np.asarray(self.thresholds), np.abs(curvature), side="right")

    def select(self, curvature: Sequence[float] | Array, current: int | None = None) -> int:
        """Select the band of the largest |curvature| in a preview, with hysteresis from `current`.

        A higher band is selected as soon as its threshold is reached, a lower one only after
        |kappa| has fallen below the threshold by the share `hysteresis`. So the band does not
        chatter while a preview stays near a threshold.
        """
        sharpest = float(np.max(np.abs(curvature))) if np.size(curvature) else 0.0
        band = int(self.classify(sharpest))
        if current is None or band >= current:
            return band
        held = int(self.classify(sharpest / (1.0 - self.hysteresis)))
        return max(band, min(held, current))

    def shares(self, path: ReferencePath) -> Array:
        """Share of a path's length in each band, (len(self),)."""
        once = path.curvature[:-1] if path.closed else path.curvature
        counts = np.bincount(self.classify(once), minlength=len(self))
        shares: Array = counts / counts.sum()
        return shares
