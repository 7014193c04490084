"""One case: a small plain dict in, a plain dict out. A benchmark is a list of cases."""

import hashlib
import inspect
import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import agents
import lpv_track_env
import trajectories
from agents.base import CHECKPOINTS
from agents.registry import check_settings, source_file
from experiments.run import learning_cost, metrics
from experiments.run.computing import ComputingTimes
from experiments.run.rollout import Rollout, rollout
from lpv_track_env import conditions, plants, vehicle
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.reward import RewardWeights
from lpv_track_env.task import SPEED_MODES
from lpv_track_env.vehicle import VehicleParameters
from trajectories.compilation import source_digest
from trajectories.naming import choose

VEHICLE_FIELDS = tuple(field.name for field in fields(VehicleParameters))
REWARD_FIELDS = tuple(field.name for field in fields(RewardWeights))
ENV_SETTINGS = tuple(
    parameter.name
    for parameter in inspect.signature(PathTrackingEnv).parameters.values()
    if parameter.kind is parameter.KEYWORD_ONLY
)
"""What `env_settings` may hold; the environment's other arguments are fields of the case."""


@dataclass(frozen=True)
class Case:
    """Everything that determines one episode.

    `conditions` is a preset's name or a dictionary of fields, see `lpv_track_env.conditions.load`.
    `computing` turns computing times into delays: the arguments of
    `experiments.run.computing.ComputingTimes`.
    `vehicle_changes` replaces fields of the vehicle, for the plant and the agents' models alike
    (say, a wider `max_lateral_velocity_ratio`); `agent_settings` and `env_settings` are keyword
    arguments of the agent's class and of the environment.
    """

    agent: str
    trajectory: str
    vehicle: str = "m2-minibus"
    conditions: str | Mapping[str, Any] = "simulation"
    seed: int = 0
    speed_mode: str = "variable"
    fixed_speed: float | None = None
    control_period: float = 0.05
    vehicle_changes: Mapping[str, Any] = field(default_factory=dict)
    agent_settings: Mapping[str, Any] = field(default_factory=dict)
    env_settings: Mapping[str, Any] = field(default_factory=dict)
    computing: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @property
    def id(self) -> str:
        """Hash of the case, the files it names and the project's sources: none changes unseen."""
        # A setting that names a .json, such as a learned policy's.
        settings = (
            Path(value)
            for value in self.agent_settings.values()
            if isinstance(value, str) and value.endswith(".json")
        )
        # One that names what is shipped for the agent, beside its default.
        shipped = (CHECKPOINTS / f"{self.agent}-{v}.json" for v in self.agent_settings.values())
        named = (
            Path(self.trajectory), Path(self.vehicle), source_file(self.agent), *settings, *shipped,
        )  # fmt: skip
        files = [
            hashlib.sha256(file.read_bytes()).hexdigest()
            for file in named
            if file is not None and file.is_file()
        ]
        content = json.dumps([self.as_dict(), files, project_digest()], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def check(self) -> None:
        """Refuse names and settings that nothing knows, before anything is driven.

        Raises
        ------
        ValueError
            Listing the known names and the nearest.
        """
        check_settings(self.agent, self.agent_settings)
        trajectories.load(self.trajectory)
        choose("speed mode", self.speed_mode, SPEED_MODES)
        conditions.load(self.plain_conditions)
        if self.computing and self.conditions == "simulation":
            raise ValueError("computing times are delays, which conditions 'simulation' have not")
        self.make_computing()
        for key in self.env_settings:
            choose("environment setting", key, ENV_SETTINGS)
        self.resolved_env_settings()
        for key in self.vehicle_changes:
            choose("vehicle field", key, VEHICLE_FIELDS)
        plants.make(self.env_settings.get("plant", plants.BICYCLE), self.make_vehicle())

    def make_vehicle(self) -> VehicleParameters:
        """The case's vehicle, with what is changed of it."""
        changes = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in self.vehicle_changes.items()
        }
        return vehicle.load(self.vehicle).replace(**changes)

    @property
    def plain_conditions(self) -> str | dict[str, Any]:
        """Conditions as the environment takes them; JSON's lists are ranges."""
        return self.conditions if isinstance(self.conditions, str) else dict(self.conditions)

    def resolved_env_settings(self) -> dict[str, Any]:
        """Settings as the environment takes them; a dictionary of reward weights is made one."""
        settings = dict(self.env_settings)
        if isinstance(weights := settings.get("reward_weights"), Mapping):
            for key in weights:
                choose("reward weight", key, REWARD_FIELDS)
            settings["reward_weights"] = RewardWeights(**weights)
        return settings

    def make_env(self, **settings: Any) -> gymnasium.Env[Any, Any]:
        """The case's environment; `settings` are added to the case's own."""
        return gymnasium.make(
            "lpv_track_env/PathTracking-v0",
            trajectory=self.trajectory,
            vehicle=self.make_vehicle(),
            speed_mode=self.speed_mode,
            fixed_speed=self.fixed_speed,
            conditions=self.plain_conditions,
            control_period=self.control_period,
            **{**self.resolved_env_settings(), **settings},
        )

    def make_computing(self) -> ComputingTimes | None:
        """The case's computing times; None: those of its conditions."""
        if not self.computing:
            return None
        return ComputingTimes(**self.computing, period=self.control_period, seed=self.seed)

    def make_agent(self, env: gymnasium.Env[Any, Any]) -> agents.Agent:
        """The case's agent for its environment."""
        return agents.make(self.agent, env, **self.agent_settings)


@cache
def project_digest() -> str:
    """Digest of all sources that a result depends on."""
    packages = (trajectories, lpv_track_env, agents)
    folders = [Path(str(package.__file__)).parent for package in packages]
    here = Path(__file__).parent
    names = ("case", "rollout", "metrics", "computing", "learning_cost")
    own = "".join((here / f"{name}.py").read_text() for name in names)
    return hashlib.sha256((source_digest(*folders) + own).encode()).hexdigest()[:16]


def run_case(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Run one case; never raises for what the case itself does wrong.

    Parameters
    ----------
    spec
        Fields of `Case`.

    Returns
    -------
    dict
        `id`, the spec's fields, `status` ("ok" or "failed" with `error`), `end`, `metrics`,
        `solver` (median, p99, max time in s; failures), `warnings`, `seconds`, and `trace`, arrays
        by name; for a learned policy `training`, what it cost (`experiments.run.learning_cost`).
    """
    case = Case(**spec)
    result: dict[str, Any] = {"id": case.id, **case.as_dict(), "status": "ok", "end": None}
    began = time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            env = case.make_env()
            computing = case.make_computing()
            agent = case.make_agent(env)
            result |= learning_cost.of_agent(agent)
            driven = rollout(env, agent, seed=case.seed, computing_time=computing)
            car = env.unwrapped.vehicle  # type: ignore[attr-defined]
            env.close()
        measured = metrics.evaluate(driven.trace, driven.path, car)
        if bad := sorted(name for name, value in measured.items() if not np.isfinite(value)):
            raise ValueError(f"metrics not finite: {', '.join(bad)}")
    except Exception as error:  # noqa: BLE001  a failed case must not end a sweep
        return {
            **result,
            "status": "failed",
            "error": f"{type(error).__name__}: {error}",
            "metrics": {},
            "solver": {},
            "warnings": [],
            "seconds": time.perf_counter() - began,
            "trace": {},
        }
    noted = [str(warning.message) for warning in caught if warning.category is UserWarning]
    return {
        **result,
        "end": driven.end,
        "metrics": measured,
        "solver": solver_summary(driven),
        "warnings": sorted({*noted, *driven.path.metadata.get("warnings", [])}),
        "seconds": time.perf_counter() - began,
        **({} if computing is None else {"latency": computing.summary()}),
        "trace": driven.trace.as_dict(),
    }


def solver_summary(driven: Rollout) -> dict[str, Any]:
    """Times of `predict` (s) over an episode, and what its solves came to.

    The first call, which may still compile or allocate, counts like every other.
    """
    calls = driven.trace.solve_time[1:]
    # Zero where the agent was still busy.
    calls = calls[calls > 0.0]
    return {
        "median": float(np.median(calls)),
        "p99": float(np.percentile(calls, 99)),
        "max": float(calls.max()),
        "failures": sum(n for status, n in driven.statuses.items() if status != "SUCCESS"),
        "statuses": driven.statuses,
        "fallbacks": driven.fallbacks,
        "mean_iterations": float(driven.iterations.mean()) if driven.iterations.size else None,
        "solves": int(driven.solver_seconds.size),
        "slack": driven.slack.tolist() if driven.solver_seconds.size else None,
    }
