"""`lpv_track_env/HighwayTrack-v0`: path tracking on highway-env's roads, among its traffic."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env.road.road import RoadNetwork
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import VX
from lpv_track_env.env import RESET_OPTIONS, PathTrackingEnv
from lpv_track_env.episodes import End
from lpv_track_env.highway import scenes
from lpv_track_env.highway.cruise import CruiseControl
from lpv_track_env.highway.traffic import EgoVehicle, TrafficReference, others_on
from lpv_track_env.task import Task
from lpv_track_env.validation import (
    check_action,
    checked_options,
    checked_seed,
    forwards_arguments,
)
from lpv_track_env.vehicle import VehicleParameters
from lpv_track_env.vehicle import load as load_vehicle
from trajectories.arguments import Whole, flag, instance_of
from trajectories.naming import choose
from trajectories.speed import SpeedLimits

SURROUNDINGS: dict[str, dict[str, Any]] = {
    "lidar": {"type": "LidarObservation"},
    "kinematics": {"type": "Kinematics", "see_behind": True},
}
"""Configurations of highway-env's observations, by their names here."""

OPTIONS = tuple(option for option in RESET_OPTIONS if option != "trajectory")
"""Reset options; highway-env draws the trajectory."""
LAPS = Whole(1, 1000)
EXTRA_TIME = 30.0
"""Default time limit beyond twice the path's duration, s."""


class HighwayTrackEnv(PathTrackingEnv):
    """A vehicle (dynamic bicycle) follows a lane of highway-env's roads, among its traffic.

    Action, reward, starting errors, conditions, plants and info are those of
    `lpv_track_env/PathTracking-v0` (`lpv_track_env.env.PathTrackingEnv`); this text describes the
    differences.

    ## Path

    The lane of the route on which highway-env starts the ego vehicle, fitted by one smooth curve
    (`lpv_track_env.highway.routes`). The reference speed is the path's own jerk-limited profile,
    lowered by adaptive cruise control to keep a gap to the vehicle ahead
    (`lpv_track_env.highway.cruise`); an agent sees this in the speeds of its preview. The cruise
    control uses positions of the traffic that are one control period old.

    ## Observation space

    `Dict(tracking=Box(8 + 2 K), surroundings=Box(...))`: the observation of path tracking
    (`lpv_track_env.observation`), and the one of highway-env. "lidar" is (16, 2): distance and
    speed of the nearest body in each sector of 22.5 degrees, in units of 60 m and 60 m/s.
    "kinematics" is (5, 5): one row for each nearby vehicle. With `flat=True` both parts are in one
    `Box`, tracking first; with `surroundings=None` there is only the tracking part. This project's
    agents use the tracking part.

    ## Episode end

    As in path tracking; `finished` means the end of the route, or of a lap (or of `laps`). And

    | end | when |
    |---|---|
    | `collision` | the body touches another (terminated; the reward's `end` term applies) |

    ## Starting state

    `reset(seed=s)` makes the same traffic as highway-env with seed s, and starts at the place of
    its ego vehicle; further resets draw new traffic. Options are those of path tracking, without
    `trajectory`.

    ## Info

    In addition to path tracking's: `gap` (m to the bumper of the vehicle ahead, inf if there is
    none), `leader_speed` (m/s along the path, inf if there is none), `lane_error` (m, offset from
    the centre of highway-env's own lane, positive to the path's left), `collision` (bool).

    ## Arguments

    scene
        A name (`lpv_track_env.highway.scenes.SCENES`), a `Scene`, or the user's `RoadNetwork`.
    route
        Names of the nodes to pass, in place of the scene's own; a lap ends where it begins.
    surroundings
        "lidar", "kinematics", a configuration of highway-env's observations, or None.
    flat
        True for an observation in one vector.
    other_vehicles
        Number of other vehicles, as the scene counts it (`Scene.make`); None for its default.
    cruise
        Settings of the gap; None keeps the path's own speed regardless of traffic.
    speed_limits
        Limits of the reference; by default 2 m/s^2 laterally, 1.5 m/s^2 longitudinally and the
        scene's speed.
    laps
        Number of laps of a closed route until the episode is finished.

    vehicle
        As in `PathTrackingEnv`; its lowest speed becomes 0, because it may have to stop.

    The other arguments are those of `PathTrackingEnv`; `time_limit` is by default twice the path's
    duration plus 30 s.

    ## Version history

    v0: first version.
    """

    @forwards_arguments(
        PathTrackingEnv, "trajectory", "speed_mode", "fixed_speed", "grip", "random_start"
    )
    def __init__(
        self,
        settings: dict[str, Any],
        scene: str | scenes.Scene | RoadNetwork = "racetrack",
        vehicle: str | Path | VehicleParameters = "m2-minibus",
        *,
        route: Sequence[str] | None = None,
        surroundings: str | Mapping[str, Any] | None = "lidar",
        flat: bool = False,
        other_vehicles: int | None = None,
        cruise: CruiseControl | None = CruiseControl(),  # noqa: B008  frozen
        speed_limits: SpeedLimits | None = None,
        laps: int = 1,
    ) -> None:
        self.scene = scenes.load(scene, route)
        self.laps, self.flat = LAPS.of("laps", laps), flag("flat", flat)
        if self.laps > 1 and not self.scene.closed:
            raise ValueError(f"laps must be exactly 1 on an open route, not {laps}")
        if cruise is not None:
            instance_of("cruise", cruise, CruiseControl, "CruiseControl or None")
        self.cruise = cruise
        if speed_limits is None:
            speed_limits = SpeedLimits(
                max_speed=self.scene.max_speed, max_lateral_acceleration=2.0, max_acceleration=1.5
            )
        self.speed_limits = instance_of(
            "speed_limits", speed_limits, SpeedLimits, "SpeedLimits or None"
        )
        config = _observation_config(surroundings)
        self.highway = self.scene.make(other_vehicles, config or SURROUNDINGS["lidar"])
        self._surrounded = config is not None
        self._ego: EgoVehicle | None = None
        path = scenes.path_of(self.scene, 0, self.speed_limits)
        super().__init__(path, stoppable(vehicle), **settings)
        self.observation_space = self._space(self.observation_space)

    def _space(self, tracking: spaces.Space[Any]) -> spaces.Space[Any]:
        """Return the space of the whole observation, from the space of its tracking part."""
        if not self._surrounded:
            return tracking
        around = self.highway.observation_type.space()
        if not self.flat:
            return spaces.Dict({"tracking": tracking, "surroundings": around})
        return spaces.flatten_space(spaces.Tuple((tracking, around)))

    def _observation_of(self, tracking: NDArray[np.float32]) -> Any:
        """Return the whole observation, from its tracking part."""
        if not self._surrounded:
            return tracking
        around = self.highway.observation_type.observe().astype(np.float32)
        if self.flat:
            return np.concatenate([tracking, around.ravel()])
        return {"tracking": tracking, "surroundings": around}

    def episode_task(self, options: Mapping[str, Any]) -> Task:
        """Make the task of an episode from the reset options `trajectory` and `vehicle`."""
        task = super().episode_task(options)
        limit = task.time_limit
        if limit is None:
            limit = self.laps * 2.0 * task.path.duration + EXTRA_TIME
        return replace(task, time_limit=limit, vehicle=stoppable(task.vehicle))

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see the class for `options`."""
        options, seed = checked_options(options, OPTIONS), checked_seed(seed)
        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        # An error below leaves no running episode, because its road is gone.
        self._running = False
        start = scenes.populate(self.highway, drawn)
        path = scenes.path_of(self.scene, int(start.lane_index[2]), self.speed_limits)
        options.setdefault("arc_length", path.project(*start.position).arc_length)
        tracking, info = super().reset(seed=seed, options={**options, "trajectory": path})
        self._record[kernels.START] += (self.laps - 1) * path.length
        self._reference = TrafficReference(path, self.vehicle, self.layout, self.cruise)
        self._take_table(self._reference.table)
        self._put_ego(start)
        self._follow_traffic()
        return self._observation_of(tracking), {**info, **self._info()}

    def _put_ego(self, start: Any) -> None:
        """Replace highway-env's ego vehicle on the road by the plant's."""
        road = self.highway.road
        self._ego = EgoVehicle(road, self.vehicle)
        road.vehicles[road.vehicles.index(start)] = self._ego
        self.highway.controlled_vehicles = [self._ego]
        self.highway.define_spaces()
        self._place()
        self._draw_others()

    def _begin_drawing(self) -> None:
        """Give the renderer, if there is one, the road and traffic of a new episode."""
        if self._renderer is not None:
            self._renderer.begin(self.task, scenes.scenery(self.highway.road.network))
            self._draw_others()

    def _draw_others(self) -> None:
        if self._renderer is not None:
            self._renderer.others = scenes.bodies(self.others)

    def _place(self) -> None:
        assert self._ego is not None
        self._ego.place(self._record[:6], float(self._record[kernels.REFERENCE_SPEED]))

    @property
    def others(self) -> list[Any]:
        """All other vehicles and objects on the road."""
        return others_on(self.highway.road, self._ego)

    def _follow_traffic(self) -> None:
        """Find the vehicle ahead, and lower the reference's speed to keep the gap."""
        s, speed = float(self._record[kernels.ARC_LENGTH]), float(self._record[VX])
        self._reference.update(s, speed, self.others)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive one control period; see the class for actions, rewards, ends and errors."""
        if self._running:
            # An action that the plant would refuse must not move the traffic.
            check_action(action)
            scenes.move(self.highway.road, self.control_period)
            self._draw_others()
        tracking, reward, terminated, truncated, info = super().step(action)
        self._place()
        scenes.collide(self.highway.road, self.control_period)
        assert self._ego is not None
        if self._ego.crashed:
            if not terminated:
                loss = -self.task.reward_weights.end
                info["reward_end"] += loss
                reward += loss
            info["end"] = End.COLLISION
            self._record[kernels.END] = kernels.COLLISION
            terminated, truncated, self._running = True, False, False
        self._follow_traffic()
        return self._observation_of(tracking), reward, terminated, truncated, info | self._info()

    def _info(self) -> dict[str, Any]:
        assert self._ego is not None
        lane = self._ego.lane.local_coordinates(self._ego.position)[1]
        leader = self._reference.leader
        return {
            "gap": float(leader.gap), "leader_speed": float(leader.speed),
            "lane_error": float(lane), "collision": bool(self._ego.crashed),
        }  # fmt: skip


def stoppable(vehicle: str | Path | VehicleParameters) -> VehicleParameters:
    """Return a vehicle with lowest speed 0: behind others, a least speed means a collision."""
    car = load_vehicle(vehicle)
    return car.replace(speed_range=(0.0, car.speed_range[1]))


def _observation_config(surroundings: str | Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return highway-env's configuration of the observation; None for no observation."""
    if surroundings is None:
        return None
    if isinstance(surroundings, str):
        return SURROUNDINGS[choose("surroundings", surroundings, tuple(SURROUNDINGS))]
    words = "a name, a configuration of highway-env or None"
    config = dict(instance_of("surroundings", surroundings, Mapping, words))
    instance_of("surroundings['type']", config.get("type"), str, "a kind of observation")
    return config
