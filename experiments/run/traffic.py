"""Cases in highway-env's traffic: this project's agents and highway-env's own controllers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from agents.registry import check_settings
from experiments.run.case import BaseCase
from experiments.run.rollout import rollout
from lpv_track_env import HIGHWAY_TRACK, kernels
from lpv_track_env.bicycle import VX

OWN = {"idm": "IDM and highway-env's own steering", "idm-mobil": "the same, and it overtakes"}
"""highway-env's own controllers, by name."""
TARGET_SPEED = 10.0
"""Speed that highway-env's own controllers aim at, m/s; the racetracks' lanes allow as much."""


@dataclass(frozen=True)
class TrafficCase(BaseCase):
    """An agent of this project, or a controller of `OWN`, in a scene of highway-env.

    `agent_settings` and `env_settings` are keyword arguments of the agent's class and of
    `lpv_track_env.highway.env.HighwayTrackEnv`.
    """

    agent: str
    scene: str = "racetrack"
    seed: int = 0
    conditions: str = "simulation"
    control_period: float = 0.05
    agent_settings: Mapping[str, Any] = field(default_factory=dict)
    env_settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def place(self) -> str:
        """Name of the scene."""
        return self.scene

    def check(self) -> None:
        """Check the agent and its settings.

        Raises
        ------
        ValueError
            For an unknown one, listing the known ones and the nearest.
        """
        if self.agent not in OWN:
            check_settings(self.agent, self.agent_settings)

    def packages(self) -> tuple[str, ...]:
        """Return the packages that compute a result."""
        return (*super().packages(), "highway-env")

    def make_env(self, **settings: Any) -> gymnasium.Env[Any, Any]:
        """Make the case's environment; `settings` are added to the case's own."""
        return gymnasium.make(
            HIGHWAY_TRACK,
            scene=self.scene,
            conditions=self.conditions,
            control_period=self.control_period,
            **{"surroundings": None, **self.env_settings, **settings},
        )

    def drive(self, result: dict[str, Any]) -> None:
        """Drive the episode; add `end`, `metrics`, and `others`, the number of other vehicles."""
        result["error"] = None
        env = self.make_env()
        result |= self._drive_own(env) if self.agent in OWN else self._drive_agent(env)
        env.close()

    def failure(self, error: str) -> dict[str, Any]:
        """Return the result of a case that failed."""
        return {**super().failure(error), "others": None}

    def _drive_agent(self, env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
        inner: Any = env.unwrapped
        record = Record()

        def note(_: int, info: dict[str, Any]) -> None:
            speed = float(info["state"][VX])
            record.add(info["lateral_error"], info["lane_error"], speed, info["gap"])

        driven = rollout(env, self.make_agent(env), seed=self.seed, on_step=note)
        calls = driven.trace.solve_time[1:]
        record.seconds += calls[calls > 0.0].tolist()
        progress = float(driven.trace.arc_length[-1] - driven.trace.arc_length[0])
        return {
            "end": driven.end,
            "others": len(inner.others),
            "metrics": record.metrics(self.control_period, progress),
        }

    def _drive_own(self, env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
        """Drive highway-env's `IDMVehicle` in place of the environment's ego vehicle.

        It starts where and as fast as highway-env has it, drives the same laps or route, and its
        episodes end in the same ways; its errors are measured against the same path. With lane
        changes (MOBIL), errors against its first lane mean little.
        """
        from highway_env.vehicle.behavior import IDMVehicle

        from lpv_track_env.highway import scenes, traffic
        from lpv_track_env.highway.cruise import CruiseControl

        inner: Any = env.unwrapped
        inner.reset(seed=self.seed)
        path, task, overtakes = inner.path, inner.task, self.agent == "idm-mobil"
        start = scenes.populate(inner.highway, self.seed)
        road = inner.highway.road
        route = [tuple(index) for index in path.metadata["route"]] if not path.closed else None
        car = IDMVehicle(
            road, start.position, start.heading, start.speed, target_speed=TARGET_SPEED,
            route=route, enable_lane_change=overtakes,
        )  # fmt: skip
        car.MIN_SPEED = 0.0
        road.vehicles[road.vehicles.index(start)] = car
        others = traffic.others_on(road, car)
        cruise, record, end = CruiseControl(), Record(), kernels.TIME_LIMIT
        s = begin = path.project(*car.position).arc_length
        goal = begin + inner.laps * path.length if path.closed else path.length
        for _ in range(task.max_steps):
            scenes.move(road, task.control_period)
            scenes.collide(road, task.control_period)
            x, y = car.position
            foot = path.project(float(x), float(y), near=s + car.speed * task.control_period)
            s = foot.arc_length
            ahead = traffic.leaders(path, s, 0.5 * car.LENGTH, 0.5 * car.WIDTH, others, cruise)
            record.add(
                foot.lateral_error,
                float(car.lane.local_coordinates(car.position)[1]),
                float(car.speed),
                min((leader.gap for leader in ahead), default=math.inf),
            )
            if car.crashed:
                end = kernels.COLLISION
            elif abs(foot.lateral_error) > task.max_lateral_error and not overtakes:
                end = kernels.LEFT_CORRIDOR
            elif s >= goal - 1e-9:
                end = kernels.FINISHED
            if end != kernels.TIME_LIMIT:
                break
        return {
            "end": kernels.END_NAMES[end],
            "others": len(others),
            "metrics": record.metrics(self.control_period, s - begin),
        }


@dataclass
class Record:
    """Quantities of every control period, lists of numbers in SI units."""

    lateral_error: list[float] = field(default_factory=list)
    lane_error: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    """Computing times; highway-env's own controllers have none."""

    def add(self, lateral_error: float, lane_error: float, speed: float, gap: float) -> None:
        """Add a control period: errors to path and lane (m), speed (m/s), gap ahead (m or inf)."""
        self.lateral_error.append(lateral_error)
        self.lane_error.append(lane_error)
        self.speed.append(speed)
        self.gap.append(gap)

    def metrics(self, period: float, progress: float) -> dict[str, float]:
        """Compute the metrics of a drive of `progress` m along its path; SI units.

        Errors are of the centre of gravity for this project's plant, of the body's centre for
        highway-env's vehicle, its point of reference.
        """
        lateral, lane = np.array(self.lateral_error), np.array(self.lane_error)
        gaps = np.array(self.gap)
        gaps = gaps[np.isfinite(gaps)]
        return {
            "lateral_rms": float(np.sqrt(np.mean(lateral**2))),
            "lateral_max": float(np.abs(lateral).max()),
            "lane_rms": float(np.sqrt(np.mean(lane**2))),
            "mean_speed": float(np.mean(self.speed)),
            "least_speed": float(np.min(self.speed)),
            "duration": period * len(self.speed),
            "progress": progress,
            **({"least_gap": float(gaps.min())} if gaps.size else {}),
            **({"predict_median": float(np.median(self.seconds))} if self.seconds else {}),
        }
