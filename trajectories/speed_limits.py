"""Limits of a speed profile, as they are given or as a vehicle has them."""

from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np

from trajectories.arguments import Number, check_fields, numbers
from trajectories.path import MINIMUM_SPEED

LIMIT = Number(1e-3, 1e6)
"""Rule of every limit of a profile, in SI units."""
CORNER = Number(-1e6, 1e6)
COMFORTABLE_SPEED = 10.0
"""m/s: top speed of a planned profile unless one is given."""
CREEPING_SPEED = 0.25
"""Lowest speed to which the kinks of a file slow a planned profile down, m/s."""
ACCELERATION_SHARE, JERK_SHARE = 0.75, 0.2
"""Shares of a vehicle's longitudinal acceleration and jerk that a comfortable profile uses: 1.5 of
the paper's 2 m/s^2, and 1 of 5 m/s^3."""
BRAKING_SHARE = 0.95
"""Deceleration by acceleration where none is given: the paper's tables have one row for both."""
UNLIMITED = 1e6
"""m/s^2: an acceleration that limits nothing."""


@runtime_checkable
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
        m/s^2; the deceleration is by default 95 % of the acceleration.
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
        acceleration (and of its braking, if that is weaker), `JERK_SHARE` of its jerk, and
        `COMFORTABLE_SPEED` if it drives that fast.
        """
        slowest, fastest = vehicle.longitudinal_acceleration_range
        acceleration, braking = ACCELERATION_SHARE * fastest, -ACCELERATION_SHARE * slowest
        weak = LIMIT.low <= braking < BRAKING_SHARE * acceleration
        return cls(
            max_speed=min(COMFORTABLE_SPEED, vehicle.speed_range[1]),
            max_lateral_acceleration=vehicle.max_lateral_acceleration,
            max_acceleration=acceleration,
            max_deceleration=braking if weak else None,
            max_jerk=JERK_SHARE * vehicle.max_jerk,
            max_steering_rate=vehicle.max_steering_rate,
            wheelbase=vehicle.wheelbase,
            min_speed=CREEPING_SPEED,
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
        """Bound on deceleration, m/s^2: `BRAKING_SHARE` of `max_acceleration` unless given."""
        if self.max_deceleration is None:
            return BRAKING_SHARE * self.max_acceleration
        return self.max_deceleration
