"""Wrappers between an agent and its environment: seen through, undone or refused.

Agents take observations and give actions in SI units. A wrapper that rescales, normalises or stacks
them would make an agent drive off the road without a word, so only those pass that are known to
hand on both unchanged, and `RescaleAction`, which is undone. Any other wrapper may say so of
itself: `passes_through = True`.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import (
    DtypeObservation,
    FilterObservation,
    FlattenObservation,
    RescaleAction,
)
from numpy.typing import NDArray

Env = gymnasium.Env[Any, Any]
Rescaling = RescaleAction[Any, Any, Any]
Layer = gymnasium.Wrapper[Any, Any, Any, Any]

HARMLESS = {
    ("gymnasium", "Wrapper"), ("gymnasium", "RewardWrapper"),
    ("gymnasium", "Autoreset"), ("gymnasium", "OrderEnforcing"),
    ("gymnasium", "PassiveEnvChecker"), ("gymnasium", "RecordEpisodeStatistics"),
    ("gymnasium", "TimeLimit"), ("gymnasium", "ClipAction"), ("gymnasium", "ClipReward"),
    ("gymnasium", "NormalizeReward"), ("gymnasium", "TransformReward"),
    ("gymnasium", "AddWhiteNoise"), ("gymnasium", "HumanRendering"), ("gymnasium", "ObstructView"),
    ("gymnasium", "RecordVideo"), ("gymnasium", "RenderCollection"),
    ("stable_baselines3", "Monitor"),
}  # fmt: skip
"""Package and name of the wrappers that hand on observations and actions unchanged.

`AddWhiteNoise` and `ObstructView` are about frames; `ClipAction` clips to the bounds that agents
keep.
"""
STEPS = (0.0, *(sign * 2.0**power for power in range(-5, 3) for sign in (-1.0, 1.0)))
"""Neighbours of an action that are tried, in units of the last place."""
CHANGING = ("step", "reset", "observation", "action")
"""Methods by which a wrapper changes what it hands on."""


def beneath(env: Env) -> tuple[Env, list[Rescaling]]:
    """Return the tracking environment beneath wrappers, and the wrappers to be undone.

    The latter are listed from the inside outwards.

    An environment, or a wrapper such as `lpv_track_env.highway.wrapper.HighwayTracking`, is one for
    tracking if it has a `layout` of its own.

    Raises
    ------
    ValueError
        For a wrapper that changes observations or actions, or may do so.
    TypeError
        For many environments in one.
    """
    given: Any = env
    if getattr(given, "num_envs", None) is not None and not isinstance(given, gymnasium.Env):
        wrapped = isinstance(given, gymnasium.vector.VectorWrapper)
        such = "in the same kind of wrapper" if wrapped else "such as envs.single or envs.envs[0]"
        raise TypeError(
            f"{type(given).__name__} holds {given.num_envs} environments: make the agent for one, "
            f"{such}; it takes batches of observations, too"
        )
    undone = []
    while isinstance(env, gymnasium.Wrapper) and not hasattr(env, "layout"):
        if isinstance(env, RescaleAction) and _keeps(env, RescaleAction):
            undone.append(env)
        elif not passes(env):
            name = type(env).__name__
            raise ValueError(
                f"{name} changes observations or actions, or may do so, and agents need those of "
                "the environment: make the agent, and let it drive, without this wrapper; if both "
                f"stay as they are, set {name}.passes_through = True"
            )
        env = env.env
    return env, undone[::-1]


def passes(layer: Layer) -> bool:
    """Tell whether a wrapper hands on observations and actions unchanged."""
    if getattr(layer, "passes_through", False) is True:
        return True
    space = layer.observation_space
    for known, harmless in (
        (FlattenObservation, space == layer.env.observation_space),
        (DtypeObservation, space.dtype in {np.dtype(np.float32), np.dtype(np.float64)}),
        (FilterObservation, isinstance(space, spaces.Dict) and "tracking" in space.spaces),
    ):
        if isinstance(layer, known) and _keeps(layer, known):
            return harmless
    for cls in type(layer).__mro__:
        if (cls.__module__.partition(".")[0], cls.__name__) in HARMLESS:
            return True
        if any(name in vars(cls) for name in CHANGING):
            return False
    return False


def _keeps(layer: Layer, known: type[Any]) -> bool:
    """Tell whether a wrapper has all methods of `CHANGING` from the known class."""
    return all(getattr(type(layer), name, None) is getattr(known, name, None) for name in CHANGING)


def rescaled(layers: Sequence[Rescaling], action: NDArray[Any]) -> NDArray[np.float64]:
    """Return the action (..., 2) that wrappers, listed from the inside, turn into `action`.

    The wrappers compute in the precision of what they are given, here float64, with which they
    reach every float32 to the last bit, except next to a zero that they shift.
    """
    wanted = np.asarray(action, dtype=np.float64)

    def reached(given: NDArray[np.float64]) -> NDArray[np.float64]:
        for layer in reversed(layers):
            given = layer.action(given)
        return given

    scale, given = np.ones(2), wanted
    for layer in layers:
        inner: Any = layer.env.action_space
        outer: Any = layer.action_space
        low, span = inner.low.astype(np.float64), inner.high.astype(np.float64) - inner.low
        if np.isfinite(span).all():  # else the wrapper leaves unbounded actions as they are
            factor = (outer.high - outer.low) / span
            given, scale = outer.low + (given - low) * factor, scale * factor
    # The wrappers' own factors are rounded to float32: corrections by the residual come close to
    # the exact action, and the best of its neighbours is taken.
    for _ in range(3):
        given = given + (wanted - reached(given)) * scale
    units = np.spacing(given), np.spacing(scale)
    tried = np.array([given + step * unit for unit in units for step in STEPS])
    best = np.abs(reached(tried) - wanted).argmin(axis=0)
    chosen: NDArray[np.float64] = np.take_along_axis(tried, best[None], axis=0)[0]
    return chosen


class AgentAround:
    """Agent around another one, whose attributes it has besides its own."""

    def __init__(self, agent: Any) -> None:
        self.agent = agent

    def __getattr__(self, name: str) -> Any:
        if name == "agent":  # not yet there while a copy or a pickle is made
            raise AttributeError(name)
        return getattr(self.agent, name)


class RescaledAgent(AgentAround):
    """Agent behind `RescaleAction` wrappers: it gives its actions in their units.

    Parameters
    ----------
    agent
        Agent for the environment beneath.
    layers
        The wrappers, from inside.
    """

    def __init__(self, agent: Any, layers: Sequence[Rescaling]) -> None:
        super().__init__(agent)
        self.layers = layers

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return the agent's action in the units of the outermost wrapper, and its memory."""
        action, memory = self.agent.predict(observation, state, episode_start, deterministic)
        return rescaled(self.layers, action), memory
