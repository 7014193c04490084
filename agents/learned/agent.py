"""Agents that run a learned policy: compiled, without torch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Action, DrivingTask, blind_control, observation_rows
from agents.learned.files import read
from agents.learned.network import Network
from agents.learned.policy import ACTIONS, Policy
from agents.made_for import check_task
from agents.nmpc.rti_agent import RtiMemory, RtiNmpc, RtiRow
from agents.registry import CHECKPOINTS

Memory = RtiMemory | list[None]


class LearnedPolicy:
    """Drives as a policy says; for origin "lpv-nmpc", on top of that agent.

    An observation that is not finite gets what every agent gives it (steering held, braking to a
    stop), and so does one of which the network makes no number; for origin "lpv-nmpc" it gets what
    that agent itself does.

    Parameters
    ----------
    task
        What is driven.
    policy
        A policy, or the .json of one.

    Raises
    ------
    ValueError
        For a file that cannot be used, or a policy made for other observations or another control
        period than the task's; the message says which.
    """

    def __init__(self, task: DrivingTask, policy: str | Path | Policy) -> None:
        self.task = task
        name = f"policy {policy.algorithm!r}" if isinstance(policy, Policy) else f"policy {policy}"
        self.policy = policy if isinstance(policy, Policy) else read(policy)
        check_task(name, self.policy, task, stacklevel=4)
        self._size = task.layout.size
        self._network = Network.of(self.policy, *task.action_bounds)
        self._base = RtiNmpc(task) if self.policy.origin == "lpv-nmpc" else None
        # Of no rows: so it compiles here, if need be, and not within the first control period.
        self._network.act(np.zeros((0, self._size)), np.zeros((0, ACTIONS)))

    def predict(
        self,
        observation: NDArray[Any],
        state: Memory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, Memory]:
        """Action (2,) for one observation (size,), or (n, 2) for a batch; and the memory.

        The memory is the base's, if there is one: a network alone remembers nothing.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        """
        rows = observation_rows(observation, self._size)
        memory: Memory
        if self._base is None:
            memory, base = [None] * len(rows), np.zeros((len(rows), ACTIONS), dtype=np.float32)
        else:
            base, memory = self._base.predict(rows, state, episode_start, deterministic)  # type: ignore[arg-type]
        actions = base.astype(np.float64)
        if self._network.act(rows, actions):
            for row in np.flatnonzero(np.isnan(actions[:, 0])).tolist():
                actions[row] = self._instead(rows[row], base[row])
        given = actions.astype(np.float32)
        return (given[0] if np.ndim(observation) == 1 else given), memory

    def _instead(self, row: NDArray[np.float64], base: Action) -> NDArray[Any]:
        """Action (2,) where the network has none."""
        if self._base is not None:
            return base
        stop = blind_control(self.task.vehicle, self.task.layout.unpack(row))
        return np.clip(stop, *self.task.action_bounds)

    def reset(self) -> None:
        """Forget everything: the next call begins new episodes."""
        if self._base is not None:
            self._base.reset()

    def diagnostics(self, memory: RtiRow | None) -> dict[str, Any]:
        """What the base can tell of its last step for one vehicle; empty without one."""
        if self._base is None or memory is None:
            return {}
        return self._base.diagnostics(memory)


def of_file(file: str | Path) -> Callable[[DrivingTask], LearnedPolicy]:
    """What makes the agent of a policy file, as a class makes its own; the file is read here.

    Raises
    ------
    ValueError
        For a file that cannot be used.
    """
    read(file)

    def made(task: DrivingTask) -> LearnedPolicy:
        return LearnedPolicy(task, file)

    return made


class Ppo(LearnedPolicy):
    """Proximal policy optimisation (Schulman et al. 2017); by default the shipped policy."""

    def __init__(
        self, task: DrivingTask, *, policy: str | Path | Policy = CHECKPOINTS / "ppo.json"
    ) -> None:
        super().__init__(task, policy)


class Sac(LearnedPolicy):
    """Soft actor-critic (Haarnoja et al. 2018), its mean action; by default the shipped policy."""

    def __init__(
        self, task: DrivingTask, *, policy: str | Path | Policy = CHECKPOINTS / "sac.json"
    ) -> None:
        super().__init__(task, policy)


class Bc(LearnedPolicy):
    """Behaviour cloning: supervised learning of the NMPC's actions; by default as shipped."""

    def __init__(
        self, task: DrivingTask, *, policy: str | Path | Policy = CHECKPOINTS / "bc.json"
    ) -> None:
        super().__init__(task, policy)
