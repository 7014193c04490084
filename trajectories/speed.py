"""Jerk-limited speed profile along a path of given curvature, by sequential linear programming.

With b = v^2 over arc length, acceleration is a = b'/2 and jerk is v a'. Maximising speed under caps
from lateral acceleration, steering rate and top speed is then linear in b, except for the jerk
bound |a'| <= j b^(-1/2). Its right side is convex in b, so linearising it about the last profile
tightens it, and every iterate is feasible (Lipp and Boyd, Minimum-time speed optimisation over a
fixed path, 2014, for the variable b; the linearisation of the jerk bound is this project's).
A closed path is a periodic problem: its differences go on over the seam.
"""

from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

from trajectories.arguments import Number, array, check_fields, instance_of, numbers
from trajectories.path import MINIMUM_POINTS, MINIMUM_SPEED, ReferencePath

Array = NDArray[np.float64]

GRAVITY = 9.81
"""m/s^2."""
GRID, COARSEST_GRID, FINE_CELLS = 1.0, 2.0, 3000
"""Largest spacing of the linear programmes' grid, m, and that of a path with more cells than
these: their number stays, until their length is the second."""
ITERATIONS = 6
"""Largest number of linear programmes."""
SETTLED = 1e-4
"""Relative gain of a lap's time that is worth a further programme for a closed path."""
STEERING_MARGIN = 0.96
"""Share of the steering rate that is used."""
JERK_MARGIN = 0.92
"""Share of the jerk that is used: at low speed the grid overshoots by up to 8 %."""
LIMIT = Number(1e-3, 1e6)
"""Rule of every limit of a profile, in SI units."""
SPACINGS = Number(1e-3, 1e9, "m")
CORNER = Number(-1e6, 1e6)
LONGEST = 40_000.0
"""m: longest path that is planned; it takes some ten seconds."""
PLANS = 64
"""Number of profiles that are kept, so that none is planned twice in a row."""
FACETS = 4
"""Facets of a quarter of the polygon within the circle of `max_total_acceleration`; at worst the
polygon is 2 % smaller, at zero longitudinal or lateral acceleration it touches the circle."""
CHATTER_WEIGHT = 2e-3
"""Weight of the L1 penalty on changes of acceleration; without it profiles chatter at the caps."""
COMFORTABLE_SPEED = 10.0
"""m/s: top speed of a planned profile unless one is given."""
ACCELERATION_SHARE, JERK_SHARE = 0.75, 0.2
"""Shares of a vehicle's longitudinal acceleration and jerk that a comfortable profile uses: 1.5 of
the paper's 2 m/s^2, and 1 of 5 m/s^3."""
UNLIMITED = 1e6
"""m/s^2: an acceleration that limits nothing."""


class PlannedVehicle(Protocol):
    """Limits of a vehicle that profiles are planned for, as in `lpv_track_env.vehicle`."""

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed, m/s."""

    @property
    def longitudinal_acceleration_range(self) -> tuple[float, float]:
        """Hardest braking (negative) and accelerating, m/s^2."""

    @property
    def max_lateral_acceleration(self) -> float:
        """Comfortable lateral acceleration, m/s^2."""

    @property
    def max_jerk(self) -> float:
        """Largest rate of the acceleration, m/s^3."""

    @property
    def max_steering_rate(self) -> float:
        """Largest rate of the steering angle, rad/s."""

    @property
    def wheelbase(self) -> float:
        """Distance between the axles, m."""


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
        m/s at both ends of an open path, or less before bends that demand it.
    min_speed
        m/s; lower caps are raised to it, so that a kink slows the reference down but never stops
        it. The default is the lowest speed in the paper's constraint table.
    max_total_acceleration
        m/s^2, of the vector of longitudinal and lateral acceleration: what a tyre that brakes lacks
        in the turn. None: each has its own bound alone.
    corners
        Corners (longitudinal, lateral), m/s^2, of a convex polygon that holds both accelerations,
        from the hardest braking to the hardest accelerating: what is left of any other kind, such
        as that of a vehicle whose axles shift load.

    Raises
    ------
    ValueError
        If a limit is not a number from 0.001 to 1e6, or the corners do not form such a polygon.
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
    corners: tuple[tuple[float, float], ...] | None = None

    def __post_init__(self) -> None:
        given = [name for name, value in vars(self).items() if value is not None]
        needed = {item.name for item in fields(self) if item.default is not None}
        rules = dict.fromkeys(sorted(needed | set(given) - {"corners"}), LIMIT)
        check_fields(self, rules, "speed limits: ")
        if self.corners is not None:
            corners = [numbers("speed limits: corners", one, CORNER, 2) for one in self.corners]
            steps = np.diff(np.array(corners), axis=0)
            turns = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
            if len(corners) < 2 or not (steps[:, 0] > 0.0).all() or (turns > 0.0).any():
                raise ValueError(
                    "speed limits: corners must be those of a convex polygon, in order"
                )
            object.__setattr__(self, "corners", tuple(corners))

    @classmethod
    def of(cls, vehicle: PlannedVehicle) -> "SpeedLimits":
        """Return the limits of a comfortable profile for a vehicle.

        They are its lateral acceleration, steering rate and wheelbase, `ACCELERATION_SHARE` of its
        acceleration, `JERK_SHARE` of its jerk, and `COMFORTABLE_SPEED` if it drives that fast.
        """
        return cls(
            max_speed=min(COMFORTABLE_SPEED, vehicle.speed_range[1]),
            max_lateral_acceleration=vehicle.max_lateral_acceleration,
            max_acceleration=ACCELERATION_SHARE * vehicle.longitudinal_acceleration_range[1],
            max_jerk=JERK_SHARE * vehicle.max_jerk,
            max_steering_rate=vehicle.max_steering_rate,
            wheelbase=vehicle.wheelbase,
        )

    @classmethod
    def hardest(cls, vehicle: PlannedVehicle) -> "SpeedLimits":
        """Return the limits that a vehicle can drive at, for speeds that somebody else planned.

        They are its top speed, its whole range of longitudinal acceleration, and its steering rate;
        lateral acceleration has no limit, since linear tyres have none.
        """
        slowest, fastest = vehicle.longitudinal_acceleration_range
        return cls(
            max_speed=vehicle.speed_range[1],
            max_lateral_acceleration=UNLIMITED,
            max_acceleration=fastest,
            max_deceleration=-slowest,
            max_jerk=vehicle.max_jerk,
            max_steering_rate=vehicle.max_steering_rate,
            wheelbase=vehicle.wheelbase,
            min_speed=MINIMUM_SPEED,
        )

    @property
    def deceleration(self) -> float:
        """Bound on deceleration, m/s^2: 95 % of `max_acceleration` unless given."""
        if self.max_deceleration is None:
            return 0.95 * self.max_acceleration
        return self.max_deceleration


def speed_caps(
    curvature: Array,
    spacing: float,
    limits: SpeedLimits,
    share: Array | float = 1.0,
    *,
    closed: bool = False,
) -> Array:
    """Pointwise bound on speed (n,), m/s, by top speed, lateral acceleration and steering rate.

    `share`, (n,) or a scalar, scales the lateral acceleration that may be used at a point.
    """
    bent = np.maximum(np.abs(curvature), 1e-9)
    lateral = np.sqrt(share * limits.max_lateral_acceleration / bent)
    steering = np.arctan(limits.wheelbase * curvature)
    slope = np.gradient(steering, spacing)
    if closed:
        slope[[0, -1]] = (steering[1] - steering[-2]) / (2.0 * spacing)
    slope = np.maximum(np.abs(slope), 1e-12)
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

    An open path starts and ends at `limits.end_speed`, or as fast as its bends allow if that is too
    fast for them; the profile of a closed one is periodic,
    its last node the first again.

    Raises
    ------
    RuntimeError
        If the linear programme finds no profile; the message contains the solver's.
    ValueError
        If the path is longer than `LONGEST`, or an argument is of another kind.
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
    length = spacing * (len(curvature) - 1)
    if not length <= LONGEST:
        raise ValueError(
            f"a speed profile over {length:.4g} m is too long: at most {LONGEST:g} m are planned"
        )
    return _planned(curvature.tobytes(), spacing, limits, bool(closed), share.tobytes()).copy()


@lru_cache(maxsize=PLANS)
def _planned(
    curvature: bytes, spacing: float, limits: SpeedLimits, closed: bool, share: bytes
) -> Array:
    """Plan as `plan_speed`, whose arrays are given as bytes."""
    if (total := limits.max_total_acceleration) is not None:
        limits = replace(
            limits,
            max_lateral_acceleration=min(limits.max_lateral_acceleration, total),
            max_acceleration=min(limits.max_acceleration, total),
            max_deceleration=min(limits.deceleration, total),
        )
    kappa, shares = np.frombuffer(curvature), np.frombuffer(share)
    caps = speed_caps(kappa, spacing, limits, shares, closed=closed)
    length = spacing * (len(kappa) - 1)
    grid = min(max(length / FINE_CELLS, GRID), COARSEST_GRID)
    cells = max(int(np.ceil(length / grid)), 8)
    coarse = np.linspace(0.0, length, cells + 1)
    fine = np.linspace(0.0, length, len(kappa))
    # The nodes of a lap: its last one is the first.
    lap = slice(-1 if closed else None)
    # A coarse node takes the lowest cap around it, so that no cap is lost between nodes.
    reach = int(np.ceil(0.5 * length / cells / spacing))
    nodes = np.rint(coarse[lap] / spacing).astype(int).clip(0, len(caps) - 1)
    lowest, bent = (
        np.lib.stride_tricks.sliding_window_view(
            np.pad(values[lap], reach, mode="wrap" if closed else "edge"), 2 * reach + 1
        )[nodes]
        for values in (caps, np.abs(kappa))
    )
    squared = _plan(
        lowest.min(axis=1) ** 2, bent.max(axis=1), length / cells, limits, closed=closed
    )
    smoothed = _smooth(squared, fine * (cells / length), closed=closed)
    planned: Array = np.sqrt(np.minimum(smoothed, limits.max_speed**2))
    if closed:
        planned[-1] = planned[0]
    return planned


def keep_speed(
    speed: Array, curvature: Array, spacing: float, limits: SpeedLimits, *, closed: bool = False
) -> Array:
    """Return the highest speeds (n,), m/s, up to given ones that keep to limits, without jerk.

    Given speeds are kept wherever top speed, lateral acceleration, steering rate and both
    longitudinal accelerations allow them. The result is never below `MINIMUM_SPEED`, which
    is also what a stop becomes.

    Parameters
    ----------
    speed, curvature
        (n,) m/s and 1/m at nodes `spacing` (m) apart.
    limits
        Limits; total acceleration and corners are not used.
    closed
        Whether the last node is the first again.
    """
    slow = replace(limits, min_speed=MINIMUM_SPEED)
    caps = np.minimum(speed_caps(curvature, spacing, slow, closed=closed), speed)
    caps = np.maximum(caps, MINIMUM_SPEED)
    if closed:
        caps = np.append(min(caps[0], caps[-1]), caps[1:-1])
    squared = caps**2
    passed = _without_jerk(squared, spacing, limits, closed=closed)
    kept: Array = np.where(passed < squared, np.sqrt(passed), caps)
    return np.append(kept, kept[0]) if closed else kept


def replanned(path: ReferencePath, limits: SpeedLimits, **metadata: Any) -> ReferencePath:
    """Return the same geometry with the profile that `limits` allow, which its metadata name.

    Raises
    ------
    RuntimeError, ValueError
        As `plan_speed`.
    """
    speed = plan_speed(path.curvature, path.spacing, limits, closed=path.closed)
    return path.with_speed(speed, limits=asdict(limits), **metadata)


def _smooth(values: Array, at: Array, *, closed: bool) -> Array:
    """Evaluate the uniform quadratic B-spline with control points `values` (m,) at indices (n,).

    Its slope, the acceleration, is continuous and linear between the midpoints of cells, whereas
    the linear programme's is a staircase; it stays within the control points' convex hull.
    """
    before, after = 2 * values[0] - values[1], 2 * values[-1] - values[-2]
    if closed:
        before, after = values[-1], values[0]
        values = np.append(values, after)
        after = values[1]
    padded = np.concatenate([[before], values, [after]])
    node = np.rint(at).astype(int).clip(0, len(values) - 1)
    u = at - node
    smoothed: Array = (
        0.5 * (0.5 - u) ** 2 * padded[node]
        + (0.75 - u * u) * padded[node + 1]
        + 0.5 * (0.5 + u) ** 2 * padded[node + 2]
    )
    return smoothed


class _Facet(NamedTuple):
    """A bound on the accelerations a and a_y: `along` a + `across` a_y <= `bound`."""

    along: float
    across: float
    bound: float
    idle: float
    """Lateral acceleration up to which the other limits keep this one, m/s^2."""


def _facets(limits: SpeedLimits) -> list[_Facet]:
    """Return the facets of the region of `limits` that its other bounds do not keep."""
    facets = []
    most = {1.0: limits.max_acceleration, -1.0: limits.deceleration}
    if (radius := limits.max_total_acceleration) is not None:
        half = 0.25 * np.pi / FACETS
        for sign, largest in most.items():
            idle = np.sqrt(max(radius**2 - largest**2, 0.0)) * np.cos(half)
            for facet in range(FACETS):
                if radius * np.cos(2.0 * half * (facet + 1)) < largest:
                    angle = half * (2 * facet + 1)
                    normal = sign * np.cos(angle), np.sin(angle)
                    facets.append(_Facet(*normal, radius * np.cos(half), idle))
    for (x, y), (next_x, next_y) in pairwise(limits.corners or ()):
        along, across = y - next_y, next_x - x
        bound = along * x + across * y
        idle = (bound - abs(along) * most[1.0 if along > 0.0 else -1.0]) / across
        facets.append(_Facet(along, across, bound, idle))
    return facets


def _within_region(
    bent: Array, caps: Array, difference: sparse.csr_matrix, limits: SpeedLimits
) -> tuple[sparse.csr_matrix, Array]:
    """Bound both accelerations in the cells by `_facets`: matrix on squared speeds, upper bounds.

    Longitudinal acceleration is `difference` b, in the cells; the lateral one at either end of a
    cell is `bent` b, (m,) 1/m. Where a speed may not fall to what the lateral acceleration allows,
    nothing is left for braking.
    """
    bent = np.minimum(bent, limits.max_lateral_acceleration / caps)
    lateral = sparse.diags(bent).tocsr()
    most_lateral = bent * caps
    first = np.arange(difference.shape[0])
    last = (first + 1) % len(bent)
    larger = np.maximum(most_lateral[first], most_lateral[last])
    rows, bounds = [sparse.csr_matrix((0, len(bent)))], [np.empty(0)]
    for facet in _facets(limits):
        cells = np.flatnonzero(larger > facet.idle)
        longitudinal = facet.along * difference[cells]
        rows += [longitudinal + facet.across * lateral[ends[cells]] for ends in (first, last)]
        bounds.append(np.full(2 * len(cells), facet.bound))
    return sparse.vstack(rows, format="csr"), np.concatenate(bounds)


def _plan(caps: Array, bent: Array, h: float, limits: SpeedLimits, *, closed: bool) -> Array:
    """Plan the squared speed (m,) on a grid of spacing h under squared caps (m,).

    `bent` is |curvature| (m,), 1/m. After the last node of a closed path comes the first again.
    """
    m = len(caps)
    end = float(caps.min()) if closed else min(limits.end_speed**2, float(caps[0]), float(caps[-1]))
    upper = caps.copy()
    lowest = min(end, limits.min_speed**2)
    lower = np.full(m, lowest)
    # a = D b, in the cells; change of a = E b, at the nodes between two cells
    if closed:
        following = sparse.identity(m, format="csr")[np.r_[1:m, 0]]
        difference = (0.5 / h * (following - sparse.identity(m))).tocsr()
        change = (difference - following.T @ difference).tocsr()
        between = slice(None)
    else:
        upper[[0, -1]] = lower[[0, -1]] = end
        difference = sparse.diags([-0.5 / h, 0.5 / h], [0, 1], shape=(m - 1, m)).tocsr()
        change = (difference[1:] - difference[:-1]).tocsr()
        between = slice(1, -1)
    cells, inner = difference.shape[0], change.shape[0]
    squared = _without_jerk(upper, h, limits, closed=closed)
    identity = sparse.identity(inner, format="csr")
    nothing = sparse.csr_matrix((cells, inner))
    region, most = _within_region(bent, caps, difference, limits)
    fastest = np.inf
    for _ in range(ITERATIONS):
        last = np.maximum(squared, lower)[between]
        # j h b^(-1/2) linearised at b0: j h (1.5 b0^(-1/2) - 0.5 b0^(-3/2) b)
        allowed = JERK_MARGIN * limits.max_jerk * h
        constant = 1.5 * allowed * last**-0.5
        slope = sparse.diags(
            [0.5 * allowed * last**-1.5], [0 if closed else 1], shape=(inner, m)
        ).tocsr()
        constraints = sparse.vstack(
            [
                sparse.hstack([difference, nothing]),
                sparse.hstack([-difference, nothing]),
                sparse.hstack([change + slope, 0 * identity]),
                sparse.hstack([slope - change, 0 * identity]),
                sparse.hstack([change, -identity]),
                sparse.hstack([-change, -identity]),
                sparse.hstack([region, sparse.csr_matrix((len(most), inner))]),
            ],
            format="csr",
        )
        faster = np.full(cells, limits.max_acceleration)
        slower = np.full(cells, limits.deceleration)
        if not closed:
            # Acceleration is zero at both ends, so jerk limits it in the first and the last cell.
            standing = allowed * end**-0.5
            faster[0] = min(faster[0], standing)
            slower[-1] = min(slower[-1], standing)
        bounds = np.concatenate([faster, slower, constant, constant, np.zeros(2 * inner), most])
        weight = np.maximum(squared, end) ** -1.5
        cost = np.concatenate([-weight, np.full(inner, CHATTER_WEIGHT)])
        result = linprog(
            cost,
            A_ub=constraints,
            b_ub=bounds,
            bounds=np.column_stack(
                [np.append(lower, np.zeros(inner)), np.append(upper, np.full(inner, np.inf))]
            ),
            method="highs",
        )
        if result.x is None and lower[0] > lowest:
            lower[[0, -1]] = lowest
            continue
        if result.x is None:
            raise RuntimeError(f"no speed profile found: {result.message}")
        planned = result.x[:m]
        time = float((planned**-0.5).sum())
        if closed and time > (1.0 - SETTLED) * fastest:
            return planned if time < fastest else squared
        moved = float(np.abs(np.sqrt(planned) - np.sqrt(squared)).max())
        squared, fastest = planned, time
        if moved < 1e-3:
            break
    return squared


def _without_jerk(caps: Array, h: float, limits: SpeedLimits, *, closed: bool) -> Array:
    """Compute the first iterate: a forward and a backward pass under acceleration bounds alone."""
    if closed:
        # The neighbours of the lowest cap do not lower it: a lap from there to there is open.
        lowest = int(np.argmin(caps))
        around = np.roll(caps, -lowest)
        lap = _without_jerk(np.append(around, around[0]), h, limits, closed=False)
        return np.roll(lap[:-1], lowest)
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
