"""Compiled: what `decide` does before and after a solve, for rows of vehicles: for an agent.

The solve between them is the agent's own: linked in here it would be compiled all over again.
"""

from typing import Any

from numpy.typing import NDArray

from agents.weight_tuning.loop_kernels import attend, choose, remember, solved
from agents.weight_tuning.watching import passed
from trajectories.compilation import compiled

Array = NDArray[Any]


@compiled
def prepare_rows(
    observations: Array, looked: Array, commands: Array, feet: Array, future: Array, nodes: Array,
    rules: Array, bands: Array, watched: Array, actions: Array, steps: int, period: Any,
    tables: Array, weights: Array, network: Array, layers: Array, sets: Array, matrix: Array,
    log_span: Any, catalogue: Array, scales: Array, window: int, scratch: Array,
) -> None:  # fmt: skip
    """Take in observations (n, size) float32 and bring `weights` (n, 10) in use up to date."""
    for row in range(observations.shape[0]):
        attend(
            row, observations, looked, commands, feet, future, nodes, rules, bands, watched,
            actions, steps, period,
        )  # fmt: skip
        choose(
            row, observations, looked, tables, rules, bands, weights, watched, network, layers,
            sets, matrix, log_span, catalogue, scales, window, scratch, steps,
        )  # fmt: skip


@compiled
def finish_rows(
    watched: Array, told: Array, commands: Array, actions: Array, future: Array
) -> None:
    """Note what the solves took and the actions (n, 2) that are sent: a period has passed."""
    for row in range(actions.shape[0]):
        solved(watched[row], told[row])
        if future.shape[0] > 0:
            remember(commands[row], actions[row, 0], actions[row, 1])
        passed(watched[row])
