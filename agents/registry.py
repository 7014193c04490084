"""Agents by name; a name's module is imported only when it is made."""

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium

from agents.base import Agent, DrivingTask
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
"""Name -> "module:Class"; the class takes a `DrivingTask` and its own keyword settings."""


CHECKPOINTS = Path(__file__).parent / "checkpoints"
"""Folder of the learned policies that come with this project: NAME.json for the agent NAME."""

POLICY_FILES = (".json", ".safetensors", ".zip")
"""How the name of a learned policy's file ends; of the last two it is said what to give instead."""

COMMON = ("delay_compensation",)
"""Settings that `make` itself takes, for every agent; some classes take it from there."""


def names() -> list[str]:
    """Names that `make` knows."""
    return list(REGISTRY)


def agent_class(name: str) -> Callable[..., Any]:
    """Class behind a name, or behind a "module:Class" or "file.py:Class" of the user's own.

    For the .json of a learned policy, what makes its agent.

    Raises
    ------
    ValueError
        For an unknown name, with the known ones and the nearest; or a file that cannot be used.
    """
    if name.endswith(POLICY_FILES):
        from agents.learned.agent import of_file

        return of_file(name)
    target = REGISTRY.get(name, name)
    module, separator, attribute = target.rpartition(":")
    if not separator:
        raise ValueError(
            f"unknown agent {name!r}; {suggestion(name, REGISTRY)}, "
            "or give your own as file.py:Class or module:Class, a learned policy as its .json"
        )
    try:
        if module.endswith(".py"):
            found: Callable[..., Any] = getattr(_module_of(Path(module).resolve()), attribute)
        else:
            found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, OSError, SyntaxError) as error:
        raise ValueError(f"agent {name!r} cannot be loaded: {error}") from error
    return found


@cache
def _module_of(file: Path) -> ModuleType:
    """A user's file as a module, loaded once a process."""
    name = f"lpv_track_user_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{file.name} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def source_file(name: str) -> Path | None:
    """File whose contents belong to a result, beside this project's sources; None if there is none.

    That of a user's own agent, or of a learned policy, a shipped one too: its digest of the weights
    stands for these.
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


def check_settings(name: str, settings: Iterable[str]) -> None:
    """Refuse settings that an agent's class does not take.

    Raises
    ------
    ValueError
        Naming the agent, its settings and the nearest.
    """
    cls = agent_class(name)
    try:
        parameters = list(inspect.signature(cls).parameters.values())[1:]
    except (TypeError, ValueError):  # not a class, or one that does not tell
        return
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    known = [parameter.name for parameter in parameters]
    for key in settings:
        if key not in (*known, *COMMON):
            hint = f"; {suggestion(key, known)}" if known else ""
            raise ValueError(f"agent {name!r} has no setting {key!r}{hint}")


def make(
    name: str,
    env: gymnasium.Env[Any, Any],
    *,
    delay_compensation: bool | None = None,
    **settings: Any,
) -> Agent:
    """Make an agent for an environment; `settings` are its class's keyword arguments.

    Parameters
    ----------
    name
        As `names` lists it, or "module:Class", "file.py:Class", or the .json of a learned policy.
    env
        What it will drive, wrapped or not.
    delay_compensation
        Whether it is shown the observation of the time at which its action lands
        (`agents.delay.DelayCompensated`); by default where the environment's conditions have
        delays. A class that says `compensates_delays` is handed this instead.

    Raises
    ------
    ValueError
        For an unknown name or setting, or an environment of another kind.
    """
    cls = agent_class(name)
    check_settings(name, settings)
    itself = getattr(cls, "compensates_delays", False)
    if itself:
        settings["delay_compensation"] = delay_compensation
    try:
        task = DrivingTask.of(env)
        agent: Agent = cls(task, **settings)
    except TypeError as error:
        raise ValueError(f"agent {name!r}: {error}") from error
    compensated = task.delayed if delay_compensation is None else delay_compensation
    if compensated and not itself:
        from agents.delay import DelayCompensated

        agent = DelayCompensated(agent, task, task.actuation, settings.get("model"))
    if env.observation_space.shape != (task.layout.size,):
        from agents.surroundings import TrackingPart

        agent = TrackingPart(agent, task)
    return agent
