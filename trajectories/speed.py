"""Jerk-limited speed profile along a path of given curvature, by sequential linear programming.

With b = v^2 over arc length, acceleration is a = b'/2 and jerk is v a'. Maximising speed under caps
from lateral acceleration, steering rate and top speed is then linear in b, except for the jerk
bound |a'| <= j b^(-1/2). Its right side is convex in b, so linearising it about the last profile
tightens it, and every iterate is feasible (Lipp and Boyd, Minimum-time speed optimisation over a
fixed path, 2014, for the variable b; the linearisation of the jerk bound is this project's).
"""

from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

from trajectories.arguments import Number, array, check_fields, instance_of
from trajectories.path import MINIMUM_POINTS, ReferencePath

Array = NDArray[np.float64]

GRAVITY = 9.81
"""m/s^2."""
GRID = 1.0
"""Largest spacing of the linear programmes' grid, m."""
ITERATIONS = 6
"""Largest number of linear programmes."""
STEERING_MARGIN = 0.96
"""Share of the steering rate that is used."""
JERK_MARGIN = 0.92
"""Share of the jerk that is used: at low speed the grid overshoots by up to 8 %."""
SEAM = 1e-6
"""Largest difference of the speeds at a lap's ends, m/s: a jerk of some mm/s^3."""
MORE_LAPS = 4
"""Attempts with one more lap at either end until the ends of the middle one meet."""
LIMIT = Number(1e-3, 1e6)
"""Rule of every limit of a profile, in SI units."""
SPACINGS = Number(1e-3, 1e9, "m")
LONG_LAP = 5_000.0
"""m: lap from which a part of it, not all, is planned before and after."""
LONGEST = 40_000.0
"""m: longest path that is planned, all laps of a closed one included; it takes minutes."""
FACETS = 4
"""Facets of a quarter of the polygon within the circle of `max_total_acceleration`; at worst the
polygon is 2 % smaller, at zero longitudinal or lateral acceleration it touches the circle."""
CHATTER_WEIGHT = 2e-3
"""Weight of the L1 penalty on changes of acceleration; without it profiles chatter at the caps."""


@dataclass(frozen=True)
class SpeedLimits:
    """Limits of a speed profile.

    Parameters
    ----------
    max_speed
        m/s.
    max_lateral_acceleration, max_acceleration, max_deceleration
        m/s^2; the deceleration is by default 95 % of the acceleration, since the paper's tables
        have one row for both.
    max_jerk
        m/s^3.
    max_steering_rate
        rad/s of the kinematic steering angle atan(wheelbase kappa).
    wheelbase
        m, of the longest vehicle that the path is designed for.
    end_speed
        m/s at both ends of an open path.
    min_speed
        m/s; lower caps are raised to it, so that a kink slows the reference down but never stops
        it. The default is the lowest speed in the paper's constraint table.
    max_total_acceleration
        m/s^2, of the vector of longitudinal and lateral acceleration: what a tyre that brakes lacks
        in the turn. None: each has its own bound alone.

    Raises
    ------
    ValueError
        If a limit is not a number from 0.001 to 1e6.
    """

    max_speed: float
    max_lateral_acceleration: float
    max_acceleration: float
    max_deceleration: float | None = None
    max_jerk: float = 1.0
    max_steering_rate: float = np.pi / 300 / 0.02
    wheelbase: float = 5.0
    end_speed: float = 1.5
    min_speed: float = 1.0
    max_total_acceleration: float | None = None

    def __post_init__(self) -> None:
        given = [name for name, value in vars(self).items() if value is not None]
        needed = {item.name for item in fields(self) if item.default is not None}
        check_fields(self, dict.fromkeys(sorted(needed | set(given)), LIMIT), "speed limits: ")

    @property
    def deceleration(self) -> float:
        """Bound on deceleration, m/s^2: 95 % of `max_acceleration` unless given."""
        if self.max_deceleration is None:
            return 0.95 * self.max_acceleration
        return self.max_deceleration


def speed_caps(
    curvature: Array, spacing: float, limits: SpeedLimits, share: Array | float = 1.0
) -> Array:
    """Pointwise bound on speed (n,), m/s, by top speed, lateral acceleration and steering rate.

    `share`, (n,) or a scalar, scales the lateral acceleration that may be used at a point.
    """
    bent = np.maximum(np.abs(curvature), 1e-9)
    lateral = np.sqrt(share * limits.max_lateral_acceleration / bent)
    steering = np.arctan(limits.wheelbase * curvature)
    slope = np.maximum(np.abs(np.gradient(steering, spacing)), 1e-12)
    caps = np.minimum(lateral, STEERING_MARGIN * limits.max_steering_rate / slope)
    bounded: Array = np.minimum(limits.max_speed, np.maximum(caps, limits.min_speed))
    return bounded


def plan_speed(
    curvature: Array,
    spacing: float,
    limits: SpeedLimits,
    *,
    closed: bool = False,
    share: Array | float = 1.0,
) -> Array:
    """Plan the fastest jerk-limited speed profile (n,), m/s, for a `curvature` (n,), 1/m.

    An open path starts and ends at `limits.end_speed`. A closed path is planned over three laps, or
    over more if it takes them to reach full speed, and the middle lap is kept, so its ends meet.
    Laps of `LONG_LAP` or more are planned with as much before and after as reaches full speed.

    Raises
    ------
    RuntimeError
        If the linear programme finds no profile; the message contains the solver's.
    ValueError
        If the path, with the laps that it takes to reach full speed, is longer than `LONGEST`, or
        an argument is of another kind.
    """
    instance_of("limits", limits, SpeedLimits, "SpeedLimits")
    spacing, curvature = SPACINGS.of("spacing", spacing), array("curvature", curvature)
    if curvature.ndim != 1 or len(curvature) < MINIMUM_POINTS or not np.isfinite(curvature).all():
        raise ValueError(
            f"curvature must be at least {MINIMUM_POINTS} finite numbers in a row, not of shape "
            f"{curvature.shape}"
        )
    share = array("share", share)
    if share.shape not in {(), curvature.shape} or not (share > 0.0).all() or share.max() > 1e3:
        raise ValueError("share must be positive numbers, one or as many as there are curvatures")
    if closed:
        lap, n = spacing * (len(curvature) - 1), len(curvature) - 1
        weakest = min(limits.max_acceleration, limits.deceleration)
        run_up = limits.max_speed * (
            0.5 * limits.max_speed / weakest + 2.0 * weakest / limits.max_jerk
        )
        # Whole laps before and after; a long lap needs no more of them than the way to full speed.
        run_up = np.ceil(run_up / lap) * lap if lap < LONG_LAP else min(4.0 * run_up, lap)
        _check_length(2.0 * run_up + lap)
        more = max(round(run_up / spacing), 1)
        shares = np.broadcast_to(share, curvature.shape)
        # The jerk bound lets a stop affect speeds far away: plan more until the ends meet.
        for around in range(more, more + MORE_LAPS * min(more, n), min(more, n)):
            if around > more and spacing * (2 * around + n) > LONGEST:
                break
            nodes = np.arange(-around, n + around + 1) % n
            nodes[-1] = nodes[-1] or n
            speed = plan_speed(curvature[nodes], spacing, limits, share=shares[nodes])
            speed = speed[around : around + n + 1].copy()
            if abs(speed[-1] - speed[0]) < SEAM:
                break
        speed[-1] = speed[0]
        return speed
    length = spacing * (len(curvature) - 1)
    _check_length(length)
    caps = speed_caps(curvature, spacing, limits, share)
    cells = max(int(np.ceil(length / GRID)), 8)
    coarse = np.linspace(0.0, length, cells + 1)
    fine = np.linspace(0.0, length, len(curvature))
    # A coarse node takes the lowest cap around it, so that no cap is lost between nodes.
    reach = int(np.ceil(0.5 * length / cells / spacing))
    nodes = np.rint(coarse / spacing).astype(int).clip(0, len(caps) - 1)
    lowest, bent = (
        np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="edge"), 2 * reach + 1)
        for values in (caps, np.abs(curvature))
    )
    squared = _plan(lowest[nodes].min(axis=1) ** 2, bent[nodes].max(axis=1), length / cells, limits)
    smoothed = _smooth(squared, fine * (cells / length))
    planned: Array = np.sqrt(np.minimum(smoothed, limits.max_speed**2))
    return planned


def replanned(path: ReferencePath, limits: SpeedLimits) -> ReferencePath:
    """Return the same geometry with the profile that `limits` allow, which its metadata name.

    Raises
    ------
    RuntimeError, ValueError
        As `plan_speed`.
    """
    speed = plan_speed(path.curvature, path.spacing, limits, closed=path.closed)
    return path.with_speed(speed, limits=asdict(limits))


def _check_length(length: float) -> None:
    if not length <= LONGEST:
        raise ValueError(
            f"a speed profile over {length:.4g} m, laps to get up to speed included, is too long: "
            f"at most {LONGEST:g} m are planned"
        )


def _smooth(values: Array, at: Array) -> Array:
    """Evaluate the uniform quadratic B-spline with control points `values` (m,) at indices (n,).

    Its slope, the acceleration, is continuous and linear between the midpoints of cells, whereas
    the linear programme's is a staircase; it stays within the control points' convex hull.
    """
    padded = np.concatenate([[2 * values[0] - values[1]], values, [2 * values[-1] - values[-2]]])
    node = np.rint(at).astype(int).clip(0, len(values) - 1)
    u = at - node
    before, here, after = padded[node], padded[node + 1], padded[node + 2]
    smoothed: Array = (
        0.5 * (0.5 - u) ** 2 * before + (0.75 - u * u) * here + 0.5 * (0.5 + u) ** 2 * after
    )
    return smoothed


def _within_circle(
    bent: Array, caps: Array, difference: sparse.csr_matrix, limits: SpeedLimits, radius: float
) -> tuple[sparse.csr_matrix, Array]:
    """Bound total acceleration in the cells by `radius`: matrix on squared speeds, upper bounds.

    Longitudinal acceleration is `difference` b, (m - 1,), the lateral one at either end of a cell
    is `bent` b, (m,) 1/m. They keep within a polygon in the circle, whose facets have the normals
    (+-cos, sin). Facets and cells that other bounds keep from it are left out. Where a speed may
    not fall to what the lateral acceleration allows, nothing is left for braking.
    """
    bent = np.minimum(bent, radius / caps)
    lateral = sparse.diags(bent).tocsr()
    rows = [sparse.csr_matrix((0, len(bent)))]
    for sign, most in ((1.0, limits.max_acceleration), (-1.0, limits.deceleration)):
        rest = np.sqrt(max(radius**2 - most**2, 0.0)) * np.cos(0.25 * np.pi / FACETS)
        cells = np.flatnonzero(np.maximum(bent[:-1] * caps[:-1], bent[1:] * caps[1:]) > rest)
        for facet in range(FACETS):
            if radius * np.cos(0.5 * np.pi / FACETS * (facet + 1)) < most:
                angle = 0.5 * np.pi / FACETS * (facet + 0.5)
                along = sign * np.cos(angle) * difference[cells]
                rows += [along + np.sin(angle) * lateral[cells + end] for end in (0, 1)]
    matrix = sparse.vstack(rows, format="csr")
    return matrix, np.full(matrix.shape[0], radius * np.cos(0.25 * np.pi / FACETS))


def _plan(caps: Array, bent: Array, h: float, limits: SpeedLimits) -> Array:
    """Plan the squared speed (m,) on a grid of spacing h under squared caps (m,).

    `bent` is |curvature| (m,), 1/m.
    """
    m = len(caps)
    end = min(limits.end_speed**2, float(caps[0]), float(caps[-1]))
    upper = caps.copy()
    upper[[0, -1]] = end
    lower = np.full(m, min(end, limits.min_speed**2))
    lower[[0, -1]] = end
    # a = D b, shape (m - 1,); change of a = E b, shape (m - 2,)
    difference = sparse.diags([-0.5 / h, 0.5 / h], [0, 1], shape=(m - 1, m)).tocsr()
    change = (difference[1:] - difference[:-1]).tocsr()
    squared = _without_jerk(upper, h, limits)
    identity = sparse.identity(m - 2, format="csr")
    nothing = sparse.csr_matrix((m - 1, m - 2))
    circle, radius = sparse.csr_matrix((0, m)), np.empty(0)
    if (total := limits.max_total_acceleration) is not None:
        circle, radius = _within_circle(bent, caps, difference, limits, total)
    for _ in range(ITERATIONS):
        inner = np.maximum(squared[1:-1], lower[1:-1])
        # j h b^(-1/2) linearised at b0: j h (1.5 b0^(-1/2) - 0.5 b0^(-3/2) b)
        allowed = JERK_MARGIN * limits.max_jerk * h
        constant = 1.5 * allowed * inner**-0.5
        slope = sparse.diags([0.5 * allowed * inner**-1.5], [1], shape=(m - 2, m)).tocsr()
        constraints = sparse.vstack(
            [
                sparse.hstack([difference, nothing]),
                sparse.hstack([-difference, nothing]),
                sparse.hstack([change + slope, 0 * identity]),
                sparse.hstack([slope - change, 0 * identity]),
                sparse.hstack([change, -identity]),
                sparse.hstack([-change, -identity]),
                sparse.hstack([circle, sparse.csr_matrix((len(radius), m - 2))]),
            ],
            format="csr",
        )
        # Acceleration is zero at both ends, so jerk limits it in the first and the last cell.
        standing = allowed * end**-0.5
        faster = np.full(m - 1, limits.max_acceleration)
        faster[0] = min(faster[0], standing)
        slower = np.full(m - 1, limits.deceleration)
        slower[-1] = min(slower[-1], standing)
        bounds = np.concatenate([faster, slower, constant, constant, np.zeros(2 * (m - 2)), radius])
        weight = np.maximum(squared, end) ** -1.5
        cost = np.concatenate([-weight, np.full(m - 2, CHATTER_WEIGHT)])
        result = linprog(
            cost,
            A_ub=constraints,
            b_ub=bounds,
            bounds=np.column_stack(
                [np.append(lower, np.zeros(m - 2)), np.append(upper, np.full(m - 2, np.inf))]
            ),
            method="highs",
        )
        if result.x is None:
            raise RuntimeError(f"no speed profile found: {result.message}")
        planned = result.x[:m]
        moved = float(np.abs(np.sqrt(planned) - np.sqrt(squared)).max())
        squared = planned
        if moved < 1e-3:
            break
    return squared


def _without_jerk(caps: Array, h: float, limits: SpeedLimits) -> Array:
    """Compute the first iterate: a forward and a backward pass under acceleration bounds alone."""
    squared = caps.copy()
    for k in range(1, len(squared)):
        squared[k] = min(squared[k], squared[k - 1] + 2 * limits.max_acceleration * h)
    for k in range(len(squared) - 2, -1, -1):
        squared[k] = min(squared[k], squared[k + 1] + 2 * limits.deceleration * h)
    return squared


def constant_speed(path: ReferencePath) -> float:
    """Highest constant speed (m/s) that a path's own limits allow all along it.

    Never below the limits' end speed, so that kinked waypoints are driven at walking pace. A path
    without limits in its metadata is driven at its lowest speed.
    """
    if "limits" not in path.metadata:
        return float(path.speed.min())
    limits = SpeedLimits(**path.metadata["limits"])
    caps = speed_caps(path.curvature, path.spacing, limits)
    return max(float(caps.min()), limits.end_speed)
