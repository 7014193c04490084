"""highway-env's own controllers on the same roads, among the same traffic."""

import math
from typing import Any

from highway_env.vehicle.behavior import IDMVehicle

from experiments.highway.drives import Record
from lpv_track_env import kernels
from lpv_track_env.highway import scenes, traffic
from lpv_track_env.highway.cruise import CruiseControl
from lpv_track_env.highway.env import HighwayTrackEnv

TARGET_SPEED = 10.0
"""m/s that it would like to drive; the racetracks' lanes allow as much."""


def drive_own(
    env: HighwayTrackEnv, seed: int, *, overtakes: bool
) -> tuple[str, int, Record, float]:
    """Drive highway-env's `IDMVehicle` where the environment would have its ego vehicle.

    It starts where and as fast as highway-env has it, drives the same laps or route, and is judged
    by the same ends; its errors are measured against the same path.

    Parameters
    ----------
    env
        Gives the scene, the path, the corridor and the time limit.
    seed
        Of the traffic.
    overtakes
        Whether it changes lanes (MOBIL); then its errors against its first lane mean little.

    Returns
    -------
    tuple
        End as `info["end"]`, number of others, record, and m of the path that were driven.
    """
    env.reset(seed=seed)
    path, task = env.path, env.task
    start = scenes.populate(env.highway, seed)
    road = env.highway.road
    car = IDMVehicle(
        road, start.position, start.heading, start.speed, target_speed=TARGET_SPEED,
        route=None if env.scene.closed else _route(path), enable_lane_change=overtakes,
    )  # fmt: skip
    car.MIN_SPEED = 0.0
    road.vehicles[road.vehicles.index(start)] = car
    others = traffic.others_on(road, car)
    period, cruise, record = task.control_period, CruiseControl(), Record()
    s = begin = path.project(*car.position).arc_length
    goal = begin + env.laps * path.length if path.closed else path.length
    for _ in range(task.max_steps):
        scenes.move(road, period)
        scenes.collide(road, period)
        x, y = car.position
        foot = path.project(float(x), float(y), near=s + car.speed * period)
        s = foot.arc_length
        record.lateral_error.append(foot.lateral_error)
        record.lane_error.append(float(car.lane.local_coordinates(car.position)[1]))
        record.speed.append(float(car.speed))
        ahead = traffic.leaders(path, s, 0.5 * car.LENGTH, 0.5 * car.WIDTH, others, cruise)
        record.gap.append(min((leader.gap for leader in ahead), default=math.inf))
        if car.crashed:
            return _ended(kernels.COLLISION), len(others), record, s - begin
        if abs(foot.lateral_error) > task.max_lateral_error and not overtakes:
            return _ended(kernels.LEFT_CORRIDOR), len(others), record, s - begin
        if s >= goal - 1e-9:
            return _ended(kernels.FINISHED), len(others), record, s - begin
    return _ended(kernels.TIME_LIMIT), len(others), record, s - begin


def _ended(code: int) -> str:
    return kernels.END_NAMES[code]


def _route(path: Any) -> list[tuple[str, str, int]]:
    return [tuple(index) for index in path.metadata["route"]]
