"""The reference of an episode: the path to track, at the speed that the environment is asked for.

In the mode "grip" the speed is planned anew for the vehicle. Its tyres, as `tyres` describes them,
hold the lateral acceleration ay beside the longitudinal one a of their own as long as neither axle
slides::

    |ay| <= sqrt((mu g)^2 - a^2) min(1 - h a / (g lr), 1 + h a / (g lf))

(front and rear axle, lightened by accelerating and by braking). The profile uses the share `grip`
of that region. Tyres that hold ay slip by angles alpha and thereby brake: of a, this is left::

    ax = a - ay (lr sin(alpha_f) + lf sin(alpha_r)) / L - rolling deceleration

So a steady turn takes some a, and the speed in it is a little lower than sqrt(grip mu g R). Braking
is planned as if the drag did not help.
"""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import trajectories
from lpv_track_env import plants, tyres
from lpv_track_env.conditions import Conditions
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath, SpeedLimits
from trajectories.arguments import Number, shown
from trajectories.importers import imported
from trajectories.naming import choose
from trajectories.speed import constant_speed, keep_speed, replanned

Array = NDArray[np.float64]

SPEED_MODES = ("variable", "fixed", "grip")
SPEED = Number(0.0, 1000.0, "m/s", above=True)
GRIP = Number(0.05, 2.0)
"""Rule of the share of grip that a profile uses; beyond 1 it cannot be driven."""
CORNERS = 17
"""Corners of the polygon of accelerations."""
ORDINARY_FRICTION = 1.0
"""Coefficient of friction for which speeds are planned where tyres are linear."""


@dataclass(frozen=True)
class SpeedChoice:
    """The speed at which a path is to be driven; the arguments of `PathTrackingEnv`.

    Parameters
    ----------
    mode
        "variable": the path's own speeds. "fixed": one for all of it. "grip": the fastest profile
        that uses no more than a share of the grip.
    fixed
        m/s; by default the highest within the path's limits.
    grip
        Share of what friction allows.

    Raises
    ------
    ValueError
        For an unknown mode, a value of another mode, or one that is missing or makes no sense.
    """

    mode: str = "variable"
    fixed: float | None = None
    grip: float | None = None

    def __post_init__(self) -> None:
        choose("speed_mode", self.mode, SPEED_MODES)
        for name, value, rule in (("fixed", self.fixed, SPEED), ("grip", self.grip, GRIP)):
            argument = "fixed_speed" if name == "fixed" else name
            if value is not None and self.mode != name:
                raise ValueError(f"{argument} needs speed_mode={name!r}")
            if value is not None:
                object.__setattr__(self, name, rule.of(argument, value))
        if self.mode == "grip" and self.grip is None:
            raise ValueError("speed_mode='grip' needs grip, a share of what friction allows")


def grip_limits(
    path: ReferencePath, car: VehicleParameters, friction: float, grip: float
) -> SpeedLimits:
    """Return the limits of a profile that uses the share `grip` of what friction allows.

    Top speed, acceleration, deceleration, jerk and steering rate are those of the vehicle, the
    speed at the ends of an open path and the lowest speed those of the path. `friction` is inf
    where tyres are linear.

    Raises
    ------
    ValueError
        If the tyres cannot overcome the rolling resistance, or braking is none of the vehicle's.
    """
    friction = friction if friction < math.inf else ORDINARY_FRICTION
    a_max, limit = tyres.of(car, friction)[:2]
    if grip * limit <= car.rolling_deceleration:
        raise ValueError(
            f"grip {grip:g} at friction {friction:g} does not overcome the rolling resistance of "
            f"vehicle {shown(car.name)}: at least {car.rolling_resistance / friction:.2g} does"
        )
    slowest, fastest = car.longitudinal_acceleration_range
    corners = accelerations(car, friction, grip)
    own = path.metadata.get("limits", {})
    return SpeedLimits(
        max_speed=car.speed_range[1],
        # That of a steady turn: more is possible only while the speed falls.
        max_lateral_acceleration=float(np.interp(0.0, *corners.T)),
        max_acceleration=min(fastest, a_max, float(corners[-1, 0])),
        max_deceleration=min(-slowest, a_max, float(-corners[0, 0])),
        max_jerk=car.max_jerk,
        max_steering_rate=car.max_steering_rate,
        wheelbase=car.wheelbase,
        corners=tuple((ax, ay) for ax, ay in corners.tolist()),
        **{name: own[name] for name in ("end_speed", "min_speed") if name in own},
    )


def accelerations(car: VehicleParameters, friction: float, grip: float) -> Array:
    """Return the corners (ax, ay), m/s^2, of the polygon of accelerations at a share of grip.

    They go from braking to accelerating, (n, 2); the polygon is convex and within the region of the
    module's description, scaled by `grip`.
    """
    _, limit, *sharpness, front, rear = tyres.of(car, friction)
    angle = np.linspace(np.pi, 0.0, CORNERS)
    whole = limit * np.cos(angle)
    lightest = np.minimum(1.0 + front * whole, 1.0 + rear * whole)
    a = grip * whole
    ay = grip * limit * np.sin(angle) * np.maximum(lightest, tyres.LEAST_LOAD)
    within = np.clip(a, -0.999 * limit, 0.999 * limit)
    left = np.sqrt(limit**2 - within**2)
    drag = np.full(CORNERS, car.rolling_deceleration)
    shares = car.rear_axle_distance / car.wheelbase, car.front_axle_distance / car.wheelbase
    for n, transfer, share in zip(sharpness, (front, rear), shares, strict=True):
        load = np.maximum(1.0 + transfer * within, tyres.LEAST_LOAD)
        # The brush tyre's slip angle by its share of the largest force, 1 - (1 - z)^3.
        z = 1.0 - np.cbrt(1.0 - np.minimum(ay / (left * load), 1.0))
        slip = z * (left / limit) * load / n
        drag += share * ay * np.sin(np.minimum(slip, 0.5 * np.pi))
    corners = np.column_stack([np.where(a < -1e-9, a, a - drag), ay])
    return _upper_hull(corners)


def _upper_hull(points: Array) -> Array:
    """Return those points (n, 2) that form the upper side of their convex hull, from left."""
    hull: list[Array] = []
    for x, y in points[np.lexsort((points[:, 1], points[:, 0]))]:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) < (y1 - y0) * (x - x0):
                break
            hull.pop()
        hull.append(np.array([x, y]))
    return np.array(hull)


def reference(
    trajectory: str | Path | ReferencePath,
    car: VehicleParameters,
    speed: SpeedChoice,
    plant: str | plants.Factory = plants.BICYCLE,
    conditions: Conditions | None = None,
) -> ReferencePath:
    """Load the path to track; set its speed as chosen, within the vehicle's limits.

    The speed of a file is planned for the vehicle, or the file's own. The latter is lowered to what
    the vehicle can drive, any other one to its highest speed.
    """
    path = trajectories.load(trajectory, vehicle=car)
    if speed.grip is not None:
        ends = plants.friction_range(plants.episode_of(plant, car), conditions)
        limits = grip_limits(path, car, 0.5 * sum(ends), speed.grip)
        path = replanned(path, limits, speed_mode="grip", grip=speed.grip)
    elif speed.mode == "fixed":
        chosen = constant_speed(path) if speed.fixed is None else speed.fixed
        path = path.with_speed(chosen, speed_mode="fixed")
    fastest = car.speed_range[1]
    lowered, why = np.minimum(path.speed, fastest), f"the vehicle's {fastest:g} m/s"
    if speed.mode == "variable" and path.metadata.get("speeds") == "file":
        hardest = SpeedLimits.hardest(car)
        lowered = keep_speed(path.speed, path.curvature, path.spacing, hardest, closed=path.closed)
        why = f"what vehicle {shown(car.name)} can drive"
    cut = path.speed - lowered
    if cut.max() > 1e-6:
        message = (
            f"path {shown(path.name)}: speed lowered to {why} on {100.0 * np.mean(cut > 1e-6):.0f} "
            f"% of its length, by up to {cut.max():.3g} m/s"
        )
        warnings.warn(message, UserWarning, stacklevel=4)
        noted = [*path.metadata.get("warnings", []), message]
        path = path.with_speed(lowered, warnings=noted)
    if imported(path) and (bend := too_sharp_bend(path, car)):
        warnings.warn(bend, UserWarning, stacklevel=4)
    return path


def too_sharp_bend(path: ReferencePath, car: VehicleParameters) -> str:
    """Describe the bend that a vehicle can follow least, with the limit that binds; "" if none."""
    curvature = np.abs(path.curvature)
    by_steering, by_sideslip = car.sharpest_turns(path.speed)
    largest = np.minimum(by_steering, by_sideslip)
    k = int(np.argmax(curvature / largest))
    if curvature[k] <= largest[k]:
        return ""
    limit = (
        f"its steering angle of {car.max_steering_angle:.3g} rad"
        if by_steering[k] < by_sideslip[k]
        else f"its limit |vy| <= {car.max_lateral_velocity_ratio:g} vx"
    )
    return (
        f"path {shown(path.name)}: bend of {1.0 / curvature[k]:.1f} m radius at "
        f"{path.arc_length[k]:.1f} m, {limit} lets vehicle {shown(car.name)} turn on "
        f"{1.0 / largest[k]:.1f} m or more at {path.speed[k]:.3g} m/s"
    )
