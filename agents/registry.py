"""Agents by name. The module of an agent is imported when the agent is made."""

import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents.base import CHECKPOINTS, Action, Agent, DrivingTask
from agents.wrappers import AgentAround, RescaledAgent, beneath
from lpv_track_env.vehicle import VehicleParameters
from lpv_track_env.vehicle import load as load_vehicle
from trajectories.arguments import flag, instance_of, shortened, shown
from trajectories.naming import suggestion

REGISTRY: dict[str, str] = {
    "lpv-nmpc": "agents.nmpc.rti_agent:RtiNmpc",
    "lpv-nmpc-tuned": "agents.weight_tuning.agent:TunedNmpc",
    "lpv-nmpc-ipopt": "agents.nmpc.ipopt_agent:IpoptNmpc",
    "lpv-mpc-frozen": "agents.nmpc.frozen:FrozenLpvMpc",
    "stanley": "agents.classical.geometric:Stanley",
    "pure-pursuit": "agents.classical.geometric:PurePursuit",
    "lqr": "agents.classical.lqr:LpvLqr",
    "pid": "agents.classical.pid:Pid",
    "ppo": "agents.learned.agent:Ppo",
    "sac": "agents.learned.agent:Sac",
    "bc": "agents.learned.agent:Bc",
}
"""Name -> "module:Class". The class takes a `DrivingTask` and its own keyword settings."""

POLICY_FILES = (".json", ".safetensors", ".zip")
"""Suffixes of policy files. The error for the last two says which file to give instead."""

COMMON = ("delay_compensation", "model")
"""Settings that `make` accepts for every agent."""


def names() -> list[str]:
    """List the names that `make` knows."""
    return list(REGISTRY)


def agent_class(name: str) -> Callable[..., Any]:
    """Find the class of a name, or of the user's own "module:Class" or "file.py:Class".

    For the .json of a learned policy, return a function that makes its agent.

    Raises
    ------
    ValueError
        For an unknown name, listing the known ones and the nearest; or for an unusable file.
    """
    if instance_of("agent", name, str, "a name").endswith(POLICY_FILES):
        from agents.learned.agent import agent_of_file

        return agent_of_file(name)
    target = REGISTRY.get(name, name)
    module, separator, attribute = target.rpartition(":")
    if not separator:
        if os.path.isdir(name):  # noqa: PTH112  False for a name that is too long
            raise ValueError(
                f"agent {shown(name)} is a folder: give one policy file in it, such as "
                "seed-0/policy.json; lpv-track benchmark alone takes a folder of trainings"
            )
        if "/" in name or os.sep in name:
            raise ValueError(f"agent {shown(name)}: there is no such folder of trainings")
        raise ValueError(
            f"unknown agent {shown(name)}; {suggestion(name, REGISTRY)}, "
            "or give your own as file.py:Class or module:Class, a learned policy as its .json"
        )
    try:
        if module.endswith(".py"):
            found: Callable[..., Any] = getattr(_module_of(Path(module).resolve()), attribute)
        else:
            found = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # a user's file may raise anything
        reason = shortened(error) or type(error).__name__
        raise ValueError(f"agent {shown(name)} cannot be loaded: {reason}") from error
    return found


@cache
def _module_of(file: Path) -> ModuleType:
    """Import a user's file as a module, once per process."""
    name = f"lpv_track_user_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{file.name} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def source_file(name: str) -> Path | None:
    """Return the file on which an agent's results depend besides this project's sources, or None.

    It is the source of a user's own agent, or the .json of a learned policy, shipped or not; that
    file contains a digest of the network's weights.
    """
    if name.endswith(".json"):
        return Path(name)
    if name in REGISTRY:
        shipped = CHECKPOINTS / f"{name}.json"
        return shipped if shipped.is_file() else None
    module, separator, _ = name.rpartition(":")
    if not separator:
        return None
    if module.endswith(".py"):
        return Path(module)
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin is not None else None


def parameters_of(name: str) -> dict[str, inspect.Parameter] | None:
    """Return the parameters of an agent's class by name; None if they are not declared.

    Raises
    ------
    ValueError
        For an unknown agent.
    """
    cls = agent_class(name)
    try:
        parameters = list(inspect.signature(cls).parameters.values())[1:]
    except (TypeError, ValueError):  # not a class, or one without a signature
        return None
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return {parameter.name: parameter for parameter in parameters}


def check_settings(name: str, settings: Iterable[str]) -> None:
    """Check the names of settings for one agent.

    Raises
    ------
    ValueError
        For an unknown one, listing the agent's settings and the nearest.
    """
    known = parameters_of(name)
    if known is None:
        return
    for key in settings:
        if key not in (*known, *COMMON):
            hint = f"; {suggestion(key, known)}" if known else ""
            raise ValueError(f"agent {shown(name)} has no setting {shown(key)}{hint}")


def make(
    name: str,
    env: gymnasium.Env[Any, Any],
    *,
    delay_compensation: bool | None = None,
    model: str | Path | VehicleParameters | None = None,
    **settings: Any,
) -> Agent:
    """Make an agent for an environment.

    Parameters
    ----------
    name
        One of `names()`, or "module:Class", "file.py:Class", or the .json of a learned policy.
    env
        Environment to drive, wrapped or not. `RescaleAction` is undone; any other wrapper that
        changes observations or actions is refused (`agents.wrappers`).
    delay_compensation
        Predict the observation to the time at which the action takes effect
        (`agents.delay.DelayCompensated`). Default: if the environment's conditions have delays.
        Classes with `compensates_delays` receive this setting and do it themselves.
    model
        Vehicle that the agent takes for the one it drives: a preset's name, a .json file or
        `VehicleParameters`. Default: the environment's own.
    **settings
        Keyword arguments of the agent's class.

    Raises
    ------
    ValueError
        For an unknown name or setting, another kind of environment, or a wrapper that changes
        observations or actions.
    """
    cls = agent_class(name)
    check_settings(name, settings)
    if delay_compensation is not None:
        delay_compensation = flag("delay_compensation", delay_compensation)
    compensates = getattr(cls, "compensates_delays", False)
    if compensates:
        settings["delay_compensation"] = delay_compensation
    try:
        env, rescaling = beneath(env)
        task = DrivingTask.of(env)
        if model is not None:
            task = replace(task, vehicle=load_vehicle(model))
        agent: Agent = cls(task, **settings)
    except TypeError as error:
        raise ValueError(f"agent {shown(name)}: {shortened(error)}") from error
    wanted = task.delayed if delay_compensation is None else delay_compensation
    if wanted and not compensates:
        from agents.delay import DelayCompensated

        agent = DelayCompensated(agent, task, task.actuation)
    if env.observation_space.shape != (task.layout.size,):
        agent = TrackingPartAgent(agent, task)
    return RescaledAgent(agent, rescaling) if rescaling else agent


class TrackingPartAgent(AgentAround):
    """Agent in an environment whose observation is longer than the tracking observation.

    It hands on the tracking part (`ObservationLayout.tracking_part`) of each observation.

    Parameters
    ----------
    agent
        Agent for the tracking observation.
    task
        Task with the layout of the tracking observation.
    """

    agent: Agent

    def __init__(self, agent: Agent, task: DrivingTask) -> None:
        super().__init__(agent)
        self.task = task

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """Return the agent's action for the tracking part of an observation, and its memory."""
        part = self.task.layout.tracking_part(observation)
        return self.agent.predict(part, state, episode_start, deterministic)
