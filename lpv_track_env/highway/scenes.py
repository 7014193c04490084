"""Roads with traffic: those of highway-env by name, or a user's own network.

====================  =========================  ================================================
name                  environment of highway-env  route
====================  =========================  ================================================
racetrack             racetrack-v1               a lap of 345 to 377 m, two lanes
racetrack-large       racetrack-large-v1         a lap of 549 to 612 m, three lanes
racetrack-oval        racetrack-oval-v1          a lap of 380 to 443 m, three lanes
roundabout            roundabout-v1              in from the south, out to the north
roundabout-generic    roundabout-generic-v1      likewise, a smaller one
====================  =========================  ================================================

Road, traffic and where the ego vehicle starts are made by highway-env itself; the environments are
those in which vehicles see each other across the ends of their lanes (`-v1`: without it they run
into each other there).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from lpv_track_env.highway import routes
from trajectories import ReferencePath
from trajectories.naming import choose
from trajectories.speed import SpeedLimits

SIMULATION_PERIOD = 1.0 / 15.0
"""s; highway-env's own: its vehicles are moved in steps that are not longer."""
CIRCUIT = ("a", "b", "c", "d", "e", "f", "g", "h", "i", "a")
OVAL = ("a", "b", "c", "d", "e", "f", "g", "h", "a")
THROUGH = ("ser", "ses", "se", "ex", "ee", "nx", "nxs", "nxr")


@dataclass(frozen=True, eq=False)
class Scene:
    """A road, its traffic, and the ego vehicle's route.

    Parameters
    ----------
    name
        Of the paths made from it.
    road
        Id of an environment of highway-env that makes road and traffic, or a road network, whose
        traffic is then `IDMVehicle` on its lanes at random.
    route
        Nodes of the network, in order; a lap ends with the node that it begins with.
    max_speed
        m/s of the reference, where the lanes allow it.
    traffic
        Key of the environment's configuration that says how many other vehicles there are; None:
        their number is the environment's own.
    config
        Configuration of the environment, beside its defaults.
    """

    name: str
    road: str | RoadNetwork
    route: tuple[str, ...]
    max_speed: float = 10.0
    traffic: str | None = "other_vehicles"
    config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def closed(self) -> bool:
        """Whether the route is a lap."""
        return self.route[0] == self.route[-1]

    def make(self, other_vehicles: int | None, observation: Mapping[str, Any]) -> AbstractEnv:
        """Make the environment of highway-env, whose road and traffic are used.

        Parameters
        ----------
        other_vehicles
            Their number, in the terms of the scene: racetracks draw up to as many and one more;
            None leaves it to the environment.
        observation
            highway-env's configuration of an observation.

        Raises
        ------
        ValueError
            If the number cannot be set, or is negative.
        """
        config: dict[str, Any] = {**self.config, "observation": dict(observation)}
        if other_vehicles is not None:
            if self.traffic is None:
                raise ValueError(f"scene {self.name!r} has its own number of other vehicles")
            if other_vehicles < 0:
                raise ValueError(f"other_vehicles must be 0 or more, not {other_vehicles}")
            config[self.traffic] = other_vehicles
        if isinstance(self.road, str):
            made: AbstractEnv = gymnasium.make(
                self.road, config=config, disable_env_checker=True
            ).unwrapped
            return made
        return NetworkEnv(self.road, self.route, config)


SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene("racetrack", "racetrack-v1", CIRCUIT),
        Scene("racetrack-large", "racetrack-large-v1", CIRCUIT),
        Scene("racetrack-oval", "racetrack-oval-v1", OVAL),
        Scene("roundabout", "roundabout-v1", THROUGH, traffic=None),
        Scene("roundabout-generic", "roundabout-generic-v1", THROUGH, traffic="vehicles_count"),
    )
}


def load(scene: "str | Scene | RoadNetwork", route: Sequence[str] | None = None) -> Scene:
    """Resolve a scene's name, a scene, or a network with a route of nodes.

    Raises
    ------
    ValueError
        For an unknown name (with the known ones and the nearest), or a network without a route.
    """
    if isinstance(scene, RoadNetwork):
        if route is None:
            raise ValueError("a road network needs a route: the names of its nodes, in order")
        return Scene("network", scene, tuple(route))
    if isinstance(scene, str):
        scene = SCENES[choose("scene", scene, tuple(SCENES))]
    if route is None:
        return scene
    return replace(scene, route=tuple(route))


def populate(highway: AbstractEnv, seed: int) -> Vehicle:
    """Make the road and traffic of a seed, and return the ego vehicle as highway-env has it.

    One thing is not left as it is: IDM brakes on below standstill, and highway-env's vehicles then
    drive off backwards; here they stop.
    """
    highway.reset(seed=seed)
    for one in highway.road.vehicles:
        one.MIN_SPEED = 0.0
    return highway.vehicle


def move(road: Road, period: float) -> None:
    """Have every vehicle decide and drive for a control period (s), in steps as highway-env's."""
    steps = math.ceil(period / SIMULATION_PERIOD - 1e-9)
    for _ in range(steps):
        road.act()
        for one in road.vehicles:
            one.step(period / steps)


def collide(road: Road, period: float) -> None:
    """Have highway-env look for collisions: who touches another is `crashed` from then on."""
    for k, one in enumerate(road.vehicles):
        for other in (*road.vehicles[k + 1 :], *road.objects):
            one.handle_collisions(other, period)


@lru_cache(maxsize=64)
def path_of(scene: Scene, lane: int, limits: SpeedLimits) -> ReferencePath:
    """Reference path of a scene's route from a lane of its first road.

    Raises
    ------
    ValueError
        If the network has no such route or lane.
    """
    network = scene.make(None, {"type": "LidarObservation"}).road.network
    route = routes.lane_route(network, scene.route, lane)
    name = f"{scene.name}-{lane}"
    return routes.reference_path(network, route, limits, closed=scene.closed, name=name)


class NetworkEnv(AbstractEnv):
    """An environment of highway-env on any network: IDM vehicles on its lanes, at random.

    The ego vehicle starts on the first road of the route, on a lane drawn at random. It makes roads
    only, and is never stepped.
    """

    APART = 20.0
    """m between vehicles at the start."""

    def __init__(
        self, network: RoadNetwork, route: Sequence[str], config: Mapping[str, Any]
    ) -> None:
        self._network, self._route = network, tuple(route)
        for begin, end in pairwise(self._route):
            if not network.graph.get(begin, {}).get(end):
                raise ValueError(f"the network has no road from {begin!r} to {end!r}")
        super().__init__(dict(config))

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """highway-env's, with traffic, and neighbours seen across the ends of lanes."""
        config: dict[str, Any] = super().default_config()
        config |= {"other_vehicles": 5, "neighbour_vehicles_connected_lanes": True}
        return config

    def _reset(self) -> None:
        self.road = Road(self._network, np_random=self.np_random)
        lanes = self._network.graph[self._route[0]][self._route[1]]
        lane = int(self.np_random.integers(len(lanes)))
        ego = Vehicle.make_on_lane(self.road, (*self._route[:2], lane), longitudinal=0.0, speed=0.0)
        self.controlled_vehicles = [ego]
        self.road.vehicles.append(ego)
        for _ in range(self.config["other_vehicles"]):
            index = self._network.random_lane_index(self.np_random)
            place = self.np_random.uniform(0.0, self._network.get_lane(index).length)
            speed = self.np_random.uniform(6.0, 9.0)
            other = IDMVehicle.make_on_lane(self.road, index, longitudinal=place, speed=speed)
            near = (
                np.hypot(*(other.position - one.position)) < self.APART
                for one in self.road.vehicles
            )
            if not any(near):
                self.road.vehicles.append(other)
