"""Task of an environment: path, vehicle, periods, limits, and their numbers for the kernels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lpv_track_env.bicycle import longest_substep
from lpv_track_env.conditions import Conditions
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.reward import RewardWeights
from lpv_track_env.validation import LARGEST_ERROR
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.arguments import Number, flag, instance_of, numbers, shown
from trajectories.projection import tightest_turn

Array = NDArray[np.float64]


PERIOD = Number(0.001, 1.0, "s")
"""Rule of a control period."""
CORRIDOR = Number(0.0, math.inf, "m", above=True)
TIME_LIMIT = Number(0.0, 1e6, "s", above=True)
"""Rule of a time limit; at its end, 11 days, a vehicle that stands still would be forgotten."""
ERROR_RANGE = Number(0.0, LARGEST_ERROR)
"""Rule of the half of a range of initial errors: m, rad, m/s."""
SPEED_ROUNDING = 1e-6
"""m/s; a start slower than the lowest speed by no more than this starts at that speed."""


def checked_period(value: float) -> float:
    """Return a control period (s) as a float, or raise a ValueError if it makes no sense."""
    return PERIOD.of("control_period", value)


def action_space(vehicles: Sequence[VehicleParameters]) -> spaces.Space[NDArray[np.float32]]:
    """Return the smallest box of [a m/s^2, delta rad], float32, with every vehicle's actions."""
    lows = [(car.acceleration_range[0], -car.max_steering_angle) for car in vehicles]
    highs = [(car.acceleration_range[1], car.max_steering_angle) for car in vehicles]
    low: NDArray[np.float32] = np.min(lows, axis=0).astype(np.float32)
    high: NDArray[np.float32] = np.max(highs, axis=0).astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def check_start(
    given: Array, path: ReferencePath, car: VehicleParameters, *, random_start: bool = False
) -> None:
    """Check the speed of a start that reset options give; `given` as in `episodes.begin`.

    Raises
    ------
    ValueError
        If it is below the vehicle's lowest speed; at a drawn arc length, even where the path is
        fastest.
    """
    start, _, _, speed_error, speed = given.tolist()
    if math.isnan(speed):
        if not speed_error < 0.0:
            return
        if math.isnan(start) and random_start:
            reference = float(path.speed.max())
        else:
            reference = float(path.sample(0.0 if math.isnan(start) else start).speed)
        speed, option = reference + speed_error, f"speed_error {speed_error:g} m/s"
    else:
        reference, option = 0.0, f"speed {speed:g} m/s"
    if speed < car.lowest_start - SPEED_ROUNDING:
        raise ValueError(
            f"reset option {option}: an episode cannot start at {speed:g} m/s, vehicle "
            f"{shown(car.name)} drives at {car.lowest_start:g} m/s or more: give at least "
            f"{car.lowest_start - reference:g}"
        )


@dataclass(frozen=True)
class Task:
    """Settings of path tracking: the arguments of `PathTrackingEnv`, resolved."""

    path: ReferencePath
    vehicle: VehicleParameters
    control_period: float
    layout: ObservationLayout
    reward_weights: RewardWeights
    max_lateral_error: float
    time_limit: float | None
    initial_error_range: tuple[float, ...] = (0.0, 0.0, 0.0)
    random_start: bool = False
    conditions: Conditions | None = None
    """None under "simulation"."""

    def __post_init__(self) -> None:
        instance_of("reward_weights", self.reward_weights, RewardWeights, "RewardWeights")
        checked = {
            "control_period": checked_period(self.control_period),
            "max_lateral_error": CORRIDOR.of("max_lateral_error", self.max_lateral_error),
            "initial_error_range": numbers(
                "initial_error_range", self.initial_error_range, ERROR_RANGE, 3
            ),
            "random_start": flag("random_start", self.random_start),
        }
        if self.time_limit is not None:
            checked["time_limit"] = TIME_LIMIT.of("time_limit", self.time_limit)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        car, half, fastest = self.vehicle, self.initial_error_range[2], self.path.speed.max()
        if half > fastest - car.lowest_start:
            raise ValueError(
                f"initial_error_range: an error of {half:g} m/s is more than any speed of path "
                f"{shown(self.path.name)} (up to {fastest:g} m/s) allows for vehicle "
                f"{shown(car.name)}: at most {fastest - car.lowest_start:g} m/s"
            )

    def check_start(self, given: Array) -> None:
        """Check the speed of a start that reset options give, as the function `check_start`."""
        check_start(given, self.path, self.vehicle, random_start=self.random_start)

    @property
    def substeps(self) -> int:
        """Number of integration steps in a control period."""
        return math.ceil(self.control_period / longest_substep(self.vehicle) - 1e-9)

    @property
    def max_steps(self) -> int:
        """Control periods until truncation; by default one and a half times the path's duration."""
        limit = 1.5 * self.path.duration + 10.0 if self.time_limit is None else self.time_limit
        return math.ceil(limit / self.control_period - 1e-9)

    @property
    def start_range(self) -> float:
        """Largest arc length of a start, m; on open paths a fifth of the length is left."""
        share = 1.0 if self.path.closed else 0.8
        return share * self.path.length if self.random_start else 0.0

    def constants(self) -> Array:
        """Return the constants of the kernels, shape (CONSTANTS_SIZE,)."""
        car, period = self.vehicle, self.control_period
        low, high = car.acceleration_range
        return np.concatenate(
            [
                car.as_array(),
                [
                    car.max_steering_angle,
                    car.max_steering_rate * period,
                    low,
                    high,
                    car.max_jerk * period,
                    period,
                    self.substeps,
                    self.layout.preview_period,
                    self.max_lateral_error,
                    self.max_steps,
                    self.path.length,
                    float(self.path.closed),
                    tightest_turn(self.path.table, self.path.closed),
                    self.start_range,
                    *self.initial_error_range,
                    car.centre_of_gravity_height,
                    car.lowest_speed,
                ],
                self.reward_weights.as_array(),
            ]
        )
