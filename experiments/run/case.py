"""Cases: a benchmark is a list of them, each a small plain dict in and a plain dict out."""

import contextlib
import hashlib
import inspect
import json
import os
import signal
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import agents
import trajectories
from agents.base import CHECKPOINTS
from agents.registry import check_settings, source_file
from agents.weights import weights_from
from experiments.run import learning_cost, metrics
from experiments.run.computing import ComputingTimes
from experiments.run.provenance import (
    COMPUTING,
    OPTIONAL,
    computing_versions,
    file_digest,
    manifest_key,
    project_digest,
)
from experiments.run.result_schema import as_stored
from experiments.run.rollout import Rollout, rollout
from experiments.run.search import Search
from lpv_track_env import conditions, plants, vehicle
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.reference import SpeedChoice, reference
from lpv_track_env.reward import RewardWeights
from lpv_track_env.task import check_start
from lpv_track_env.validation import checked_start
from lpv_track_env.vehicle import VehicleParameters
from trajectories.arguments import instance_of, shortened
from trajectories.naming import choose

VEHICLE_FIELDS = tuple(field.name for field in fields(VehicleParameters))
REWARD_FIELDS = tuple(field.name for field in fields(RewardWeights))
LONGEST_MESSAGE = 1000
"""Most characters of an error or warning in a result."""


def keyword_settings(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of a function's keyword-only parameters.

    Of an environment they are what `env_settings` may hold; its other arguments are fields of a
    case.
    """
    parameters = inspect.signature(function).parameters.values()
    return tuple(one.name for one in parameters if one.kind is one.KEYWORD_ONLY)


class BaseCase(ABC):
    """Everything that determines one episode; kinds of cases are frozen dataclasses."""

    agent: str
    seed: int
    control_period: float
    agent_settings: Mapping[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)  # type: ignore[call-overload, no-any-return]

    @property
    def id(self) -> str:
        """Hash of the case, the files it names, the project's sources and the packages' versions.

        Other versions of NumPy or Numba change the last digits of a result, as other sources may.
        """
        digests = [file_digest(file) for file in self.present_files()]
        versions = computing_versions(*self.packages())
        content = json.dumps([vars(self), digests, project_digest(), versions], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def packages(self) -> tuple[str, ...]:
        """Return the packages that compute a result; a user's own agent may use any of them."""
        own = self.agent not in agents.names() and not self.agent.endswith(".json")
        return (*COMPUTING, *(OPTIONAL if own else ()))

    def files(self) -> list[Path | None]:
        """Return the files whose contents a result depends on, beside the project's sources."""
        settings = [value for value in self.agent_settings.values() if isinstance(value, str)]
        return [
            source_file(self.agent),
            *(Path(value) for value in settings if value.endswith(".json")),
            # A setting may name a checkpoint that is shipped beside the agent's default.
            *(CHECKPOINTS / f"{self.agent}-{value}.json" for value in settings),
        ]

    def present_files(self) -> list[Path]:
        """Return those of `files` that are there."""
        # Path.is_file raises for names that no file can have.
        return [file for file in self.files() if file is not None and os.path.isfile(file)]  # noqa: PTH113

    @property
    def reset_options(self) -> dict[str, Any]:
        """Options of the episode's reset."""
        return {}

    @property
    @abstractmethod
    def place(self) -> str:
        """Name of the trajectory or scene."""

    @abstractmethod
    def check(self) -> None:
        """Raise ValueError for unknown names and settings, before anything is driven."""

    @abstractmethod
    def make_env(self, **settings: Any) -> gymnasium.Env[Any, Any]:
        """Make the case's environment; `settings` are added to the case's own."""

    def make_computing(self) -> ComputingTimes | None:
        """Make the case's computing times; None leaves them to its conditions."""
        return None

    def make_agent(self, env: gymnasium.Env[Any, Any]) -> agents.Agent:
        """Make the case's agent for its environment."""
        return agents.make(self.agent, env, **self.agent_settings)

    @abstractmethod
    def drive(self, result: dict[str, Any]) -> None:
        """Drive the episode and add its outcome to the result, such as `end` and `metrics`.

        Entries that are added before an exception stay in the result of the failed case.
        """

    def failure(self, error: str) -> dict[str, Any]:
        """Return the result of a case that failed."""
        return {
            "id": self.id,
            **self.as_dict(),
            "status": "failed",
            "end": None,
            "error": error,
            "metrics": {},
            "solver": {},
            "warnings": [],
            "seconds": 0.0,
            "manifest": manifest_key(),
            "trace": {},
        }


@dataclass(frozen=True)
class Case(BaseCase):
    """An agent on a trajectory.

    `conditions` is a preset's name or a dictionary of fields, see `lpv_track_env.conditions.load`.
    `computing` turns computing times into delays: the arguments of
    `experiments.run.computing.ComputingTimes`.
    `vehicle_changes` replaces fields of the vehicle, for the plant and the agents' models alike
    (say, a wider `max_lateral_velocity_ratio`); `agent_settings` and `env_settings` are keyword
    arguments of the agent's class and of the environment. `regime` names what a case is meant to
    try, such as "slow actuators": tables put the cases of a regime together. `start` holds reset
    options that say where the vehicle starts: any of `lpv_track_env.episodes.GIVEN`. `search` asks
    for the highest value of a setting with which the agent passes: the arguments of
    `experiments.run.search.Search`. The result is then that of the drive with that value.
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
    regime: str = ""
    start: Mapping[str, float] = field(default_factory=dict)
    grip: float | None = None
    search: Mapping[str, Any] = field(default_factory=dict)

    @property
    def reset_options(self) -> dict[str, Any]:
        """Start of the vehicle."""
        return dict(self.start)

    @property
    def place(self) -> str:
        """Name of the trajectory, or its file."""
        return self.trajectory

    def files(self) -> list[Path | None]:
        """Return the files whose contents a result depends on, beside the project's sources."""
        return [Path(self.trajectory), Path(self.vehicle), *super().files()]

    def check(self) -> None:
        """Check names and settings, before anything is driven.

        Raises
        ------
        ValueError
            For an unknown one, listing the known ones and the nearest.
        """
        if self.search:
            for case in self._ends_of_search():
                case.check()
            return
        check_settings(self.agent, self.agent_settings)
        weights = self.agent_settings.get("weights")
        if self.agent in agents.names() and isinstance(weights, Mapping):
            weights_from(weights)
        instance_of("regime", self.regime, str, "text")
        speed = SpeedChoice(self.speed_mode, self.fixed_speed, self.grip)
        given = conditions.load(self.plain_conditions)
        if self.computing and self.conditions == "simulation":
            raise ValueError("computing times are delays, which conditions 'simulation' have not")
        self.make_computing()
        for key in self.env_settings:
            choose("environment setting", key, keyword_settings(PathTrackingEnv))
        self.resolved_env_settings()
        for key in self.vehicle_changes:
            choose("vehicle field", key, VEHICLE_FIELDS)
        car = self.make_vehicle()
        trajectories.load(self.trajectory, vehicle=car)
        plant = self.env_settings.get("plant", plants.BICYCLE)
        plants.make(plant, car)
        if self.start:
            path = reference(self.trajectory, car, speed, plant, given)
            check_start(checked_start(self.start, path.length), path, car)

    def _with(self, setting: str, value: float) -> "Case":
        """Return the case of a single drive of a search."""
        changes: dict[str, Any] = {"search": {}, setting: value}
        return replace(self, **changes)

    def _ends_of_search(self) -> list["Case"]:
        """Return the cases of a search's lowest and highest value.

        Raises
        ------
        ValueError
            If the case has a value of the setting already, for speeds that the vehicle does not
            reach, or as `Search`.
        """
        wanted = Search(**self.search)
        if getattr(self, wanted.setting) is not None:
            raise ValueError(f"give {wanted.setting} or a search for its highest value, not both")
        fastest = self.make_vehicle().speed_range[1]
        if wanted.setting == "fixed_speed" and wanted.high > fastest:
            raise ValueError(f"search: high must be at most the vehicle's top speed, {fastest:g}")
        return [self._with(wanted.setting, wanted.value(k)) for k in (0, wanted.last)]

    def packages(self) -> tuple[str, ...]:
        """Return the packages that compute a result."""
        independent = self.env_settings.get("plant", plants.BICYCLE) != plants.BICYCLE
        return (*super().packages(), *(("commonroad-vehicle-models",) if independent else ()))

    def make_vehicle(self) -> VehicleParameters:
        """Return the case's vehicle with its changes."""
        changes = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in self.vehicle_changes.items()
        }
        return vehicle.load(self.vehicle).replace(**changes)

    @property
    def plain_conditions(self) -> str | dict[str, Any]:
        """Conditions as `lpv_track_env.conditions.load` takes them."""
        return self.conditions if isinstance(self.conditions, str) else dict(self.conditions)

    def resolved_env_settings(self) -> dict[str, Any]:
        """Return the settings as the environment takes them, with `RewardWeights` made."""
        settings = dict(self.env_settings)
        if isinstance(weights := settings.get("reward_weights"), Mapping):
            for key in weights:
                choose("reward weight", key, REWARD_FIELDS)
            settings["reward_weights"] = RewardWeights(**weights)
        return settings

    def make_env(self, **settings: Any) -> gymnasium.Env[Any, Any]:
        """Make the case's environment; `settings` are added to the case's own."""
        return gymnasium.make(
            "lpv_track_env/PathTracking-v0",
            trajectory=self.trajectory,
            vehicle=self.make_vehicle(),
            speed_mode=self.speed_mode,
            fixed_speed=self.fixed_speed,
            grip=self.grip,
            conditions=self.plain_conditions,
            control_period=self.control_period,
            **{**self.resolved_env_settings(), **settings},
        )

    def make_computing(self) -> ComputingTimes | None:
        """Make the case's computing times; None leaves them to its conditions."""
        if not self.computing:
            return None
        return ComputingTimes(**self.computing, period=self.control_period, seed=self.seed)

    def drive(self, result: dict[str, Any]) -> None:
        """Drive the episode and add its outcome to the result.

        Added are `end`, `metrics`, `solver` (median, p99, max time in s; failures), `warnings`, and
        `trace`, arrays by name; for a learned policy `training`, the cost of making it
        (`experiments.run.learning_cost`); with computing times `latency`; after a search `tried`.
        """
        if self.search:
            wanted = Search(**self.search)

            def attempt(value: float) -> dict[str, Any]:
                one: dict[str, Any] = {}
                self._with(wanted.setting, value).drive(one)
                return one

            result |= wanted.run(attempt)
        else:
            self._drive_once(result)

    def _drive_once(self, result: dict[str, Any]) -> None:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            env = self.make_env()
            computing = self.make_computing()
            agent = self.make_agent(env)
            result |= learning_cost.of_agent(agent)
            driven = rollout(
                env, agent, seed=self.seed, options=self.reset_options, computing_time=computing
            )
            car = env.unwrapped.vehicle  # type: ignore[attr-defined]
            env.close()
        for warning in caught:
            # Of the machine, not of the result, such as damaged code on disk.
            if issubclass(warning.category, RuntimeWarning):
                warnings.showwarning(
                    warning.message, warning.category, warning.filename, warning.lineno
                )
        measured = metrics.evaluate(driven.trace, driven.path, car)
        if bad := sorted(name for name, value in measured.items() if not np.isfinite(value)):
            raise ValueError(f"metrics not finite: {', '.join(bad)}")
        noted = [str(warning.message) for warning in caught if warning.category is UserWarning]
        noted += map(str, driven.path.metadata.get("warnings", []))
        result |= {
            "end": driven.end,
            "metrics": measured,
            "solver": solver_summary(driven),
            "warnings": sorted({shortened(text, LONGEST_MESSAGE) for text in noted}),
            **({} if computing is None else {"latency": computing.summary()}),
            "trace": driven.trace.as_dict(),
        }


def run_case(spec: Mapping[str, Any], kind: type[BaseCase] = Case) -> dict[str, Any]:
    """Run one case; whatever goes wrong in it becomes its result.

    The result has `id`, the spec's fields, `status` ("ok" or "failed" with `error`), `seconds`, and
    the entries of the case's `drive`. It is as a folder of results gives it back: a case whose
    result cannot be stored has failed.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C.
    """
    case = kind(**spec)
    first = {
        "id": case.id, **case.as_dict(), "status": "ok", "end": None, "manifest": manifest_key(),
    }  # fmt: skip
    result, began = dict(first), time.perf_counter()
    try:
        # An agent may change the working directory, on which names of files depend.
        with contextlib.chdir("."):
            case.drive(result)
        return as_stored({**result, "seconds": time.perf_counter() - began})
    except BaseException as error:
        # A worker ignores Ctrl-C: there, the agent itself raised it.
        ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        if isinstance(error, KeyboardInterrupt) and not ignored:
            raise
        failure = {**case.failure(in_words(error)), "id": first["id"]}
    failure["seconds"] = time.perf_counter() - began
    try:
        return as_stored({**result, **failure})
    except Exception:  # noqa: BLE001  an entry of the drive is what cannot be stored
        return as_stored({**first, **failure})


def in_words(error: BaseException) -> str:
    """Return kind and message of an exception in one line; a message that raises is left out."""
    kind = type(error).__name__
    try:
        return f"{kind}: {shortened(error, LONGEST_MESSAGE)}"
    except BaseException:  # noqa: BLE001  a user's own __str__
        return f"{kind}, whose message cannot be read"


def failed_case(spec: Mapping[str, Any], error: str, kind: type[BaseCase] = Case) -> dict[str, Any]:
    """Return the result of a case that could not be run to its end, with the reason."""
    return as_stored(kind(**spec).failure(error))


def solver_summary(driven: Rollout) -> dict[str, Any]:
    """Summarise the times of `predict` (s) and the solves of an episode.

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
