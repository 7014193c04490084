"""The reference of an episode: the path to track, at the speed that the environment is asked for.

In the mode "grip" the speed is planned anew for the vehicle. Its tyres, as `tyres` describes them,
hold the lateral acceleration ay beside a longitudinal one ax as long as neither axle slides::

    |ay| <= sqrt((mu g)^2 - ax^2) min(1 - h ax / (g lr), 1 + h ax / (g lf))

(front and rear axle, lightened by accelerating and by braking). The profile keeps ax and ay to the
share `grip` of that region.
"""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import trajectories
from lpv_track_env import plants, tyres
from lpv_track_env.conditions import Conditions
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath, SpeedLimits
from trajectories.arguments import Number, shown
from trajectories.importers import imported
from trajectories.naming import choose
from trajectories.speed import GRAVITY, constant_speed, replanned

SPEED_MODES = ("variable", "fixed", "grip")
SPEED = Number(0.0, 1000.0, "m/s", above=True)
GRIP = Number(0.05, 2.0)
"""Rule of the share of grip that a profile uses; beyond 1 it cannot be driven."""
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
    """
    friction = friction if friction < math.inf else ORDINARY_FRICTION
    longest = tyres.of(car, friction)[0]
    slowest, fastest = car.longitudinal_acceleration_range
    own = path.metadata.get("limits", {})
    return SpeedLimits(
        max_speed=car.speed_range[1],
        max_lateral_acceleration=grip * friction * GRAVITY,
        max_acceleration=min(fastest, longest),
        max_deceleration=min(-slowest, longest),
        max_jerk=car.max_jerk,
        max_steering_rate=car.max_steering_rate,
        wheelbase=car.wheelbase,
        max_total_acceleration=grip * friction * GRAVITY,
        front_load_transfer=friction * car.centre_of_gravity_height / car.rear_axle_distance,
        rear_load_transfer=friction * car.centre_of_gravity_height / car.front_axle_distance,
        **{name: own[name] for name in ("end_speed", "min_speed") if name in own},
    )


def reference(
    trajectory: str | Path | ReferencePath,
    car: VehicleParameters,
    speed: SpeedChoice,
    plant: str | plants.Factory = plants.BICYCLE,
    conditions: Conditions | None = None,
) -> ReferencePath:
    """Load the path to track; set its speed as chosen, at most the vehicle's highest speed."""
    path = trajectories.load(trajectory)
    if speed.grip is not None:
        ends = plants.friction_range(plants.episode_of(plant, car), conditions)
        limits = grip_limits(path, car, 0.5 * sum(ends), speed.grip)
        path = replanned(path, limits, speed_mode="grip", grip=speed.grip)
    elif speed.mode == "fixed":
        chosen = constant_speed(path) if speed.fixed is None else speed.fixed
        path = path.with_speed(chosen, speed_mode="fixed")
    fastest = car.speed_range[1]
    if path.speed.max() > fastest:
        message = f"path {shown(path.name)}: speed lowered to the vehicle's {fastest:g} m/s"
        warnings.warn(message, UserWarning, stacklevel=4)
        noted = [*path.metadata.get("warnings", []), message]
        path = path.with_speed(np.minimum(path.speed, fastest), warnings=noted)
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
