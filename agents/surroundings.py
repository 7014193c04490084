"""Agents where an observation holds more than tracking: they take their part of it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Action, Agent, DrivingTask


class TrackingPart:
    """An agent of the tracking observation, shown one with the surroundings beside it.

    Parameters
    ----------
    agent
        Any agent.
    task
        What it was made for: its layout says what its part is.
    """

    def __init__(self, agent: Agent, task: DrivingTask) -> None:
        self.agent, self.task = agent, task

    def __getattr__(self, name: str) -> Any:
        if name == "agent":
            raise AttributeError(name)
        return getattr(self.agent, name)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Action, Any]:
        """As the agent's own, of the tracking part: of a dictionary, or of what begins with it."""
        part = self.task.layout.tracking_part(observation)
        return self.agent.predict(part, state, episode_start, deterministic)
