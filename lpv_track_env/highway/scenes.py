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

highway-env itself makes the road, the traffic and the start of the ego vehicle. Its `-v1`
environments are used, in which vehicles notice each other across the ends of lanes; in the others
they collide there.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from numpy.typing import NDArray

from lpv_track_env.highway import routes
from lpv_track_env.rendering import Scenery
from trajectories import ReferencePath
from trajectories.arguments import Whole, instance_of, shown
from trajectories.naming import choose
from trajectories.speed import SpeedLimits

SIMULATION_PERIOD = 1.0 / 15.0
"""Longest step in which highway-env moves its vehicles, s."""
CIRCUIT = ("a", "b", "c", "d", "e", "f", "g", "h", "i", "a")
OVAL = ("a", "b", "c", "d", "e", "f", "g", "h", "a")
THROUGH = ("ser", "ses", "se", "ex", "ee", "nx", "nxs", "nxr")

SURFACE_LENGTH = 10.0
"""Length of a lane that is drawn as one surface, m."""
EDGE_SPACING = 1.0
"""Distance between the drawn points of a lane's edges, m."""

OTHER_VEHICLES = Whole(0, 1000)
"""Rule of a number of vehicles; each of them looks for all others in every step."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """A road, its traffic, and the route of the ego vehicle.

    Parameters
    ----------
    name
        Name of the scene and of the paths made from it.
    road
        Id of a highway-env environment that makes road and traffic, or a road network, on whose
        lanes `IDMVehicle`s are placed at random.
    route
        Nodes of the network, in order; a lap ends with its first node.
    max_speed
        Largest speed of the reference, m/s, where the lanes allow it.
    traffic
        Key for the number of other vehicles in the environment's configuration; None if the number
        cannot be set.
    config
        Changes to the environment's default configuration.
    """

    name: str
    road: str | RoadNetwork
    route: tuple[str, ...]
    max_speed: float = 10.0
    traffic: str | None = "other_vehicles"
    config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def closed(self) -> bool:
        """True if the route is a lap."""
        return self.route[0] == self.route[-1]

    def make(self, other_vehicles: int | None, observation: Mapping[str, Any]) -> AbstractEnv:
        """Make the highway-env environment that provides road and traffic.

        Parameters
        ----------
        other_vehicles
            Value of the scene's `traffic` key: racetracks draw up to one vehicle more than that.
            None keeps the environment's own number.
        observation
            Configuration of highway-env's observation.

        Raises
        ------
        ValueError
            If the number of vehicles cannot be set, or is negative.
        """
        config: dict[str, Any] = {**self.config, "observation": dict(observation)}
        if other_vehicles is not None:
            if self.traffic is None:
                raise ValueError(f"scene {shown(self.name)} has its own number of other vehicles")
            config[self.traffic] = OTHER_VEHICLES.of("other_vehicles", other_vehicles)
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
    """Return the scene of a name, of a road network with a route, or a scene with another route.

    Raises
    ------
    ValueError
        For an unknown name (the message lists the known ones and the nearest), or for a network
        without a route.
    """
    if isinstance(scene, RoadNetwork):
        if route is None:
            raise ValueError("a road network needs a route: the names of its nodes, in order")
        return Scene("network", scene, _nodes(route))
    if not isinstance(scene, Scene):
        scene = SCENES[choose("scene", scene, tuple(SCENES))]
    if route is None:
        return scene
    return replace(scene, route=_nodes(route))


def _nodes(route: Sequence[str]) -> tuple[str, ...]:
    """Return the nodes of a route, two or more of them."""
    words = "two or more names of nodes, in order"
    nodes = tuple(instance_of("route", route, list | tuple, words))
    if len(nodes) < 2 or not all(isinstance(node, Hashable) for node in nodes):
        raise ValueError(f"route must be {words}, not {shown(route)}")
    return nodes


def populate(highway: AbstractEnv, seed: int) -> Vehicle:
    """Make the road and traffic of a seed, and return highway-env's ego vehicle.

    One thing is changed: IDM brakes on below standstill, so highway-env's vehicles would drive
    backwards; here they stop.
    """
    highway.reset(seed=seed)
    for vehicle in highway.road.vehicles:
        vehicle.MIN_SPEED = 0.0
    return highway.vehicle


def move(road: Road, period: float) -> None:
    """Let every vehicle decide and drive for a control period (s), in equal steps."""
    steps = math.ceil(period / SIMULATION_PERIOD - 1e-9)
    for _ in range(steps):
        road.act()
        for vehicle in road.vehicles:
            vehicle.step(period / steps)


def collide(road: Road, period: float) -> None:
    """Let highway-env check for collisions; vehicles that touch another body become `crashed`."""
    for k, vehicle in enumerate(road.vehicles):
        for other in (*road.vehicles[k + 1 :], *road.objects):
            vehicle.handle_collisions(other, period)


@lru_cache(maxsize=64)
def path_of(scene: Scene, lane: int, limits: SpeedLimits) -> ReferencePath:
    """Make the reference path of a scene's route, starting on a lane of its first road.

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
    """highway-env environment on any road network, with IDM vehicles at random on its lanes.

    The ego vehicle starts on the first road of the route, on a random lane. The environment only
    makes roads and traffic; it is never stepped.
    """

    APART = 20.0
    """Least distance between vehicles at the start, m."""

    def __init__(
        self, network: RoadNetwork, route: Sequence[str], config: Mapping[str, Any]
    ) -> None:
        self._network, self._route = network, tuple(route)
        for begin, end in pairwise(self._route):
            if not network.graph.get(begin, {}).get(end):
                raise ValueError(f"the network has no road from {shown(begin)} to {shown(end)}")
        super().__init__(dict(config))

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """highway-env's default configuration, with traffic and neighbours across ends of lanes."""
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
            distances = [
                np.hypot(*(other.position - vehicle.position)) for vehicle in self.road.vehicles
            ]
            if min(distances) >= self.APART:
                self.road.vehicles.append(other)


def scenery(network: RoadNetwork) -> Scenery:
    """Return the surfaces and painted lines of all lanes, for the renderer."""
    surfaces: list[Array] = []
    lines: list[tuple[Array, bool]] = []
    for lane in network.lanes_list():
        at = np.linspace(0.0, lane.length, max(int(np.ceil(lane.length / EDGE_SPACING)), 1) + 1)
        # highway-env's lateral coordinate grows towards the left of a path here.
        edges = [_edge(lane, at, side) for side in (-0.5, 0.5)]
        step = max(int(SURFACE_LENGTH / EDGE_SPACING), 1)
        for k in range(0, len(at) - 1, step):
            part = slice(k, k + step + 1)
            surfaces.append(np.vstack([edges[0][part], edges[1][part][::-1]]))
        for edge, kind in zip(edges, lane.line_types, strict=True):
            if kind != LineType.NONE:
                lines.append((edge, kind == LineType.STRIPED))
    return Scenery(surfaces, lines)


def _edge(lane: AbstractLane, at: Array, side: float) -> Array:
    return np.array([lane.position(s, side * lane.width_at(s)) for s in at], dtype=np.float64)


def bodies(others: Sequence[RoadObject]) -> Array:
    """Return bodies for the renderer, (m, 5): X m, Y m, heading rad, length m, width m."""
    rows = [(*body.position, body.heading, body.LENGTH, body.WIDTH) for body in others]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)
