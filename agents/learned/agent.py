"""Agents that run a learned policy: compiled, without torch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import (
    CHECKPOINTS,
    Action,
    DrivingTask,
    blind_control,
    check_compatible,
    checked_task,
)
from agents.inputs import foreign, observation_rows, started_rows
from agents.learned.context import Followed, with_context
from agents.learned.network import Network
from agents.learned.policy import ACTIONS, Policy, read
from agents.nmpc.rti_agent import RtiMemory, RtiNmpc, RtiRow

Memory = RtiMemory | list[None]


class LearnedPolicy:
    """Agent that runs a learned policy; with origin "lpv-nmpc" it corrects that agent's action.

    If the observation or the network's output is not finite, the agent holds the steering and
    brakes to a stop, as every agent does; with origin "lpv-nmpc" that agent's own action is used.

    Parameters
    ----------
    task
        Task to drive.
    policy
        A policy, or the .json of one.

    Raises
    ------
    ValueError
        For an unusable file, or for a policy that was made for another observation layout or
        control period than the task's.
    """

    def __init__(self, task: DrivingTask, policy: str | Path | Policy) -> None:
        self.task = checked_task(task)
        self.policy = policy if isinstance(policy, Policy) else read(policy)
        name = repr(policy.algorithm) if isinstance(policy, Policy) else policy
        check_compatible(
            f"policy {name}", task, layout=self.policy.layout,
            control_period=self.policy.control_period,
            vehicle=self.policy.training.get("vehicle"), stacklevel=4,
        )  # fmt: skip
        self._size = task.layout.size
        self._network = Network.of(with_context(self.policy, task), *task.action_bounds)
        self._followed = Followed(task) if self.policy.context else None
        self._base = RtiNmpc(task) if self.policy.origin == "lpv-nmpc" else None
        # Called with zero rows to trigger compilation here, not in the first control period.
        none = observation_rows(np.zeros((0, self._size)), self._size)
        self._network.act(none, np.zeros((0, ACTIONS)))

    def predict(
        self,
        observation: NDArray[Any],
        state: Memory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, Memory]:
        """Return the action (2,) for one observation (size,), or (n, 2) for a batch; and memory.

        It is the memory of the base agent; a network alone has none.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        TypeError
            If `state` is not this agent's memory.
        """
        rows = observation_rows(observation, self._size)
        memory: Memory
        if self._base is None:
            if not (state is None or isinstance(state, list)):
                raise foreign(state)
            started_rows(episode_start, len(rows))  # a check only
            memory, base = [None] * len(rows), np.zeros((len(rows), ACTIONS), dtype=np.float32)
        else:
            base, memory = self._base.predict(rows, state, episode_start, deterministic)  # type: ignore[arg-type]
        actions = base.astype(np.float64)
        if self._followed is not None:
            self._followed.replace(rows)
        if self._network.act(rows, actions):
            for row in np.flatnonzero(np.isnan(actions[:, 0])).tolist():
                actions[row] = self._replacement(rows[row], base[row])
        given = actions.astype(np.float32)
        return (given[0] if np.ndim(observation) == 1 else given), memory

    def _replacement(self, row: NDArray[np.float64], base: Action) -> NDArray[Any]:
        """Return the action (2,) that replaces an output that is not finite."""
        if self._base is not None:
            return base
        stop = blind_control(self.task.vehicle, self.task.layout.unpack(row))
        return np.clip(stop, *self.task.action_bounds)

    def reset(self) -> None:
        """Discard all memories: the next call begins new episodes."""
        if self._base is not None:
            self._base.reset()

    def diagnostics(self, memory: RtiRow | None) -> dict[str, Any]:
        """Return the base agent's diagnostics for one vehicle; empty without a base agent."""
        if self._base is None or memory is None:
            return {}
        return self._base.diagnostics(memory)


def agent_of_file(file: str | Path) -> Callable[[DrivingTask], LearnedPolicy]:
    """Check a policy file, and return a function that makes its agent for a task.

    Raises
    ------
    ValueError
        For an unusable file.
    """
    read(file)

    def make(task: DrivingTask) -> LearnedPolicy:
        return LearnedPolicy(task, file)

    return make


class Ppo(LearnedPolicy):
    """Proximal policy optimisation (Schulman et al. 2017); the shipped policy by default."""

    def __init__(
        self, task: DrivingTask, *, policy: str | Path | Policy = CHECKPOINTS / "ppo.json"
    ) -> None:
        super().__init__(task, policy)


class Sac(LearnedPolicy):
    """Soft actor-critic (Haarnoja et al. 2018), mean action; the shipped policy by default."""

    def __init__(
        self, task: DrivingTask, *, policy: str | Path | Policy = CHECKPOINTS / "sac.json"
    ) -> None:
        super().__init__(task, policy)


class Bc(LearnedPolicy):
    """Behaviour cloning of the NMPC's actions; the shipped policy by default."""

    def __init__(
        self, task: DrivingTask, *, policy: str | Path | Policy = CHECKPOINTS / "bc.json"
    ) -> None:
        super().__init__(task, policy)
