"""Compiled: one control period of vehicles whose weights are chosen as they drive, for an agent."""

from typing import Any

from numpy.typing import NDArray

from agents.nmpc.closed_loop_kernels import ASKED, HELD, decide, passed
from trajectories.compilation import compiled

Array = NDArray[Any]


@compiled
def decide_rows(
    period: Any, observations: Array, looked: Array, commands: Array, feet: Array, future: Array,
    tables: Array, rules: Array, bands: Array, weights: Array, watched: Array, until_band: bool,
    since: Array, network: Array, layers: Array, sets: Array, matrix: Array, log_span: Any,
    catalogue: Array, scales: Array, window: int, constants: Array, plans: Array, flags: Array,
    told: Array, states: Array, actions: Array, asked: Array, sums: Array, nodes: Array,
    scratch: Array, stages: Array, lanes: Array,
) -> int:  # fmt: skip
    """What `drive_rows` does before it drives, a period for every row; how many solves failed.

    Observations (n, size) float32; `asked` (n,) is HELD in the end where a solve has failed: that
    row's action is to be replaced and sent. For the other arguments see `decide`.
    """
    failed = 0
    for row in range(observations.shape[0]):
        # From the array and not as it stands here: then one compiled `decide` does for all.
        asked[row] = ASKED
        asked[row] = decide(
            row, asked[row], period, observations, looked, commands, feet, future, tables, rules,
            bands, weights, watched, until_band, since, network, layers, sets, matrix, log_span,
            catalogue, scales, window, constants, plans, flags, told, states, actions, sums, nodes,
            scratch, stages, lanes,
        )  # fmt: skip
        passed(watched[row])
        if asked[row] == HELD:
            failed += 1
    return failed
