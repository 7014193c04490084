"""Agents of path tracking in highway-env's own environments, driving its own vehicle."""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ContinuousAction
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from lpv_track_env.conditions import Actuation
from lpv_track_env.estimation.observer import PathObserver
from lpv_track_env.highway.cruise import CruiseControl
from lpv_track_env.highway.routes import lane_route, reference_path, road_ahead
from lpv_track_env.highway.traffic import TrafficReference, others_on
from lpv_track_env.observation import PREVIEW_STEPS, ObservationLayout
from lpv_track_env.task import action_space
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.speed import SpeedLimits

LIMITS = SpeedLimits(max_speed=10.0, max_lateral_acceleration=2.0, max_acceleration=1.5)


def vehicle_of(env: AbstractEnv) -> VehicleParameters:
    """Describe highway-env's vehicle by parameters, with the bounds of an environment's action.

    Its kinematic bicycle has the yaw rate v sin(beta) / (L / 2), tan(beta) = tan(delta) / 2, with L
    the length of its body: a wheelbase of L, the centre of gravity in the middle. It has no slip
    and so no tyres; the stiffness here gives a neutral vehicle the same turns, with 2 degrees of
    slip at 5 m/s^2. highway-env limits no rates; the steering rate here is within a driver's reach.

    Raises
    ------
    ValueError
        If the environment's action is not continuous, or its vehicle has dynamics.
    """
    action = env.action_type
    if not (isinstance(action, ContinuousAction) and type(action) is ContinuousAction):
        raise ValueError(
            "highway-env's action must be continuous: make the environment with "
            "config={'action': {'type': 'ContinuousAction'}}"
        )
    if action.dynamical or not action.lateral:
        raise ValueError(
            "highway-env's vehicle must be its kinematic one and be steered: "
            "leave 'dynamical' and 'lateral' of its action at their defaults"
        )
    low, high = action.acceleration_range
    half = 0.5 * Vehicle.LENGTH
    return VehicleParameters(
        name="highway-env",
        source="highway_env.vehicle.kinematics.Vehicle",
        mass=1500.0,
        yaw_inertia=1500.0 * half**2,
        front_axle_distance=half,
        rear_axle_distance=half,
        front_cornering_stiffness=1.0e5,
        rear_cornering_stiffness=1.0e5,
        rolling_resistance=0.0,
        max_steering_angle=min(action.steering_range[1], math.pi / 6),
        max_steering_rate=1.0,
        acceleration_range=(float(low), float(high)),
        longitudinal_acceleration_range=(float(low), float(high)),
        max_jerk=20.0,
        max_lateral_velocity_ratio=0.5,
        speed_range=(0.0, 30.0),
        length=Vehicle.LENGTH,
        width=Vehicle.WIDTH,
    )


def flat(info: dict[str, Any]) -> dict[str, Any]:
    """Return an info of highway-env without its dictionary `rewards`: one entry for each term."""
    terms = {
        f"reward_{name.removesuffix('_reward')}": float(value)
        for name, value in info.get("rewards", {}).items()
    }
    return {key: value for key, value in info.items() if key != "rewards"} | terms


class HighwayTracking(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment of highway-env with the observation and action of this project's agents.

    Vehicle, simulation, reward and ends are highway-env's own. The observation is the one of path
    tracking (`lpv_track_env.observation`) along the vehicle's route, the action is [acceleration
    m/s^2, steering angle rad]; so `agents.make("lpv-nmpc", env)` can drive it::

        env = HighwayTracking(
            gymnasium.make("racetrack-v1", config={"action": {"type": "ContinuousAction"}})
        )
        agent = agents.make("lpv-nmpc", env)
        observation, info = env.reset(seed=0)
        action, record = agent.predict(observation)
        observation, reward, terminated, truncated, info = env.step(action)

    The control period is the period of the environment's policy; controllers need a
    `policy_frequency` of 10 or more. If the environment's action has no throttle, the reference has
    the vehicle's speed, and no gap is kept.

    In addition to highway-env's, with its `rewards` as `reward_collision` and so on, infos contain
    `lateral_error`, `heading_error`, `speed_error`, `arc_length` and `state` as in path tracking,
    and `gap`.

    Parameters
    ----------
    env
        highway-env's environment with a `ContinuousAction` and the kinematic vehicle.
    route
        Names of the nodes to pass; the first two are the road on which the vehicle starts. By
        default the road is followed to its end, or around a lap.
    cruise
        Settings of the gap to keep, or None.
    speed_limits
        Speed limits of the reference.
    preview_steps
        Number K of preview steps, each of 0.1 s.

    Raises
    ------
    ValueError
        If the environment is not highway-env's, or its action or vehicle is not supported.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        route: Sequence[str] | None = None,
        *,
        cruise: CruiseControl | None = CruiseControl(),  # noqa: B008  frozen
        speed_limits: SpeedLimits = LIMITS,
        preview_steps: int = PREVIEW_STEPS,
    ) -> None:
        super().__init__(env)
        inner = env.unwrapped
        if not isinstance(inner, AbstractEnv):
            raise ValueError(f"{type(inner).__name__} is not an environment of highway-env")  # noqa: TRY004
        self.highway, self.vehicle = inner, vehicle_of(inner)
        self.control_period = 1.0 / inner.config["policy_frequency"]
        self.layout = ObservationLayout(preview_steps)
        self.actuation, self.friction_range = Actuation(), (math.inf, math.inf)
        self.route = None if route is None else tuple(route)
        self._throttle = bool(inner.action_type.longitudinal)
        self._cruise = cruise if self._throttle else None
        self._limits = speed_limits
        bound = self.layout.bound
        self.observation_space = spaces.Box(-bound, bound, dtype=np.float32)
        self.action_space = action_space([self.vehicle])
        self._begin()

    @property
    def path(self) -> ReferencePath:
        """Reference path of the current episode."""
        return self._reference.path

    def _begin(self) -> None:
        """Begin an episode: make the reference from the place where the vehicle starts."""
        network, start = self.highway.road.network, self.highway.vehicle
        begin, end, lane = start.lane_index
        nodes = road_ahead(network, begin, end) if self.route is None else self.route
        if nodes[:2] != (begin, end):
            raise ValueError(f"the vehicle starts from {begin!r} to {end!r}: begin the route there")
        closed = nodes[0] == nodes[-1]
        route = lane_route(network, nodes, int(lane))
        name = f"{type(self.highway).__name__}-{lane}"
        path = reference_path(network, route, self._limits, closed=closed, name=name)
        if not self._throttle:
            path = path.with_speed(max(float(start.speed), 1.0))
        self._reference = TrafficReference(path, self.vehicle, self.layout, self._cruise)
        self._observer = PathObserver(path, self.layout, self._reference.table)
        self._observer.begin(self._state())

    def _state(self) -> NDArray[np.float64]:
        """Return the vehicle's state [vx, vy, psi, r, X, Y], (6,)."""
        car = self.highway.vehicle
        slip = math.atan(0.5 * math.tan(float(car.action["steering"])))
        vx, vy = car.speed * math.cos(slip), car.speed * math.sin(slip)
        yaw_rate = car.speed * math.sin(slip) / (0.5 * car.LENGTH)
        return np.array([vx, vy, car.heading, yaw_rate, *car.position], dtype=np.float64)

    def _observe(self, ahead: float) -> NDArray[np.float32]:
        """Observe the vehicle, whose foot point is about `ahead` m after the last one."""
        action = self.highway.vehicle.action
        return self._observer.observe(
            self._state(), float(action["acceleration"]), float(action["steering"]), ahead
        )

    def _follow_traffic(self) -> None:
        road, car = self.highway.road, self.highway.vehicle
        self._reference.update(self._observer.arc_length, float(car.speed), others_on(road, car))

    def _info(self) -> dict[str, Any]:
        observer = self._observer
        return {
            "lateral_error": observer.lateral_error,
            "heading_error": observer.heading_error,
            "speed_error": observer.speed_error,
            "arc_length": observer.arc_length,
            "state": observer.state,
            "gap": float(self._reference.leader.gap),
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode of highway-env."""
        _, info = self.env.reset(seed=seed, options=options)
        self._begin()
        observation = self._observe(0.0)
        self._follow_traffic()
        return observation, {**flat(info), **self._info()}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Drive one period of highway-env's policy under [acceleration, steering angle]."""
        kind = self.highway.action_type
        scaled = [
            float(np.interp(value, bounds, (-1.0, 1.0)))
            for value, bounds in zip(
                action, (kind.acceleration_range, kind.steering_range), strict=True
            )
        ]
        given = np.array(scaled if self._throttle else scaled[1:], dtype=np.float32)
        ahead = float(self.highway.vehicle.speed) * self.control_period
        _, reward, terminated, truncated, info = self.env.step(given)
        observation = self._observe(ahead)
        self._follow_traffic()
        info = {**flat(info), **self._info()}
        return observation, reward, bool(terminated), bool(truncated), info
