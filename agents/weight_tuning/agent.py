"""The NMPC whose weights are chosen while it drives: `lpv-nmpc-tuned`."""

import time
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from agents.base import CHECKPOINTS, Action, DrivingTask, check_compatible, observation_rows
from agents.delay import NearFuture, moved_plan
from agents.nmpc import qp as program
from agents.nmpc.rti_agent import RtiNmpc
from agents.nmpc.rti_solver import DAMPING
from agents.reference import NODE
from agents.weight_tuning.deciding import NOBODY, Decider
from agents.weight_tuning.deciding_rows import finish_rows, prepare_rows
from agents.weight_tuning.loop_memory import LoopMemory, LoopRow
from agents.weight_tuning.policy import WeightPolicy, load
from agents.weight_tuning.watching import REJECTED
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.vehicle import VehicleParameters

Weights = WeightPolicy | WeightSchedule | TrackingWeights

SHIPPED = {
    "search": CHECKPOINTS / "lpv-nmpc-tuned.json",
    "paired": CHECKPOINTS / "lpv-nmpc-tuned-paired.json",
}
"""Weights that come with this project, by the method of `lpv-track tune` that found them: the best
fixed set, for whatever is seen, and a policy for the usual observations."""


class TunedNmpc:
    """`lpv-nmpc`, its weights chosen as it drives: by a weight policy, a schedule, or fixed ones.

    A policy decides anew every window and at every change of band, on what the agent itself sees
    and does; what it does is bit for bit what `ClosedLoop.drive` does with it. Decisions that are
    no numbers leave the weights as they are, all others are within the bounds of `WeightChoice`;
    failed solves go down the ladder of `lpv-nmpc`.

    Parameters
    ----------
    task
        What is driven.
    weights
        A policy, a schedule, a set, or the .json of one of the first two; as shipped: "search",
        the best fixed set, or "paired", a policy.
    delay_compensation
        Whether the NMPC is shown the observation of the time at which its action lands, see
        `agents.delay`; by default where the task has delays. Errors and lags are watched in the
        observations as they come.
    horizon, model, linear_penalty, quadratic_penalty, damping, tolerance, max_failures, threads
        As in `RtiNmpc`.

    Raises
    ------
    ValueError
        For a file that cannot be used, a policy made for other observations or another control
        period than the task's, or as `RtiNmpc`.
    """

    compensates_delays: ClassVar[bool] = True
    """It takes `delay_compensation` itself: `agents.make` wraps nothing around it."""

    def __init__(
        self,
        task: DrivingTask,
        *,
        weights: str | Path | Weights = "search",
        delay_compensation: bool | None = None,
        horizon: int | None = None,
        model: VehicleParameters | None = None,
        linear_penalty: tuple[float, float, float] = (20.0, 20.0, 20.0),
        quadratic_penalty: tuple[float, float, float] = (100.0, 100.0, 100.0),
        damping: tuple[float, float] = DAMPING,
        tolerance: float = 1e-12,
        max_failures: int = 10,
        threads: int = 1,
    ) -> None:
        self.task = task
        self.weights = _given(weights)
        policy = self.weights if isinstance(self.weights, WeightPolicy) else None
        if policy is not None:
            named = weights if isinstance(weights, str | Path) else repr(policy.algorithm)
            check_compatible(
                f"policy of weights {named}", task, layout=policy.layout,
                control_period=policy.control_period, vehicle=policy.training.get("vehicle"),
                stacklevel=4,
            )  # fmt: skip
        self.nmpc = RtiNmpc(
            task,
            horizon=horizon,
            weights=None if isinstance(self.weights, WeightPolicy) else self.weights,
            model=model,
            linear_penalty=linear_penalty,
            quadratic_penalty=quadratic_penalty,
            damping=damping,
            tolerance=tolerance,
            max_failures=max_failures,
            threads=threads,
        )
        delayed = task.delayed if delay_compensation is None else delay_compensation
        self.future = NearFuture(task, task.actuation, model) if delayed else None
        self._decider = (
            None if policy is None else Decider(policy.choice, policy.layers, task.control_period)
        )
        widest = 1 if self._decider is None else self._decider.widest
        self._nodes = np.zeros((task.layout.preview_steps + 1, NODE))
        self._scratch = np.zeros((2, widest), dtype=np.float32)
        self._memory: LoopMemory | None = None
        # Of no rows: so it compiles here, if need be, and not within the first control period.
        self._decide(np.zeros((0, task.layout.size), dtype=np.float32), self._new(0))

    def _new(self, rows: int) -> LoopMemory:
        sets = np.zeros((1, 10)) if self._decider is None else self._decider.packed.sets
        horizon, size = self.nmpc.problem.horizon, self.task.layout.size
        return LoopMemory(rows, horizon, size, self.future, sets)

    def reset(self) -> None:
        """Forget everything: the next call begins new episodes."""
        self._memory = None

    def predict(
        self,
        observation: NDArray[Any],
        state: LoopMemory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002  part of the protocol
    ) -> tuple[Action, LoopMemory]:
        """Action (2,) for one observation (size,), or (n, 2) for a batch; and the memory.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        """
        with np.errstate(over="ignore"):  # what float32 cannot hold is not finite
            rows = observation_rows(observation, self.task.layout.size).astype(np.float32)
        n = len(rows)
        memory = self._memory if state is None else state
        starts = np.zeros(n, dtype=np.bool_)
        if episode_start is not None:
            starts |= np.broadcast_to(np.asarray(episode_start, dtype=bool), (n,))
        if memory is None or len(memory) != n:
            memory = self._new(n)
            starts[:] = True
        if state is None:
            self._memory = memory
        for row in np.flatnonzero(starts).tolist():
            memory.clear(row, rows[row])
        self._decide(rows, memory)
        actions = memory.nmpc.actions.astype(np.float32)
        return (actions[0] if np.ndim(observation) == 1 else actions), memory

    def _decide(self, rows: NDArray[np.float32], memory: LoopMemory) -> None:
        """Fill `memory.nmpc.actions` for observations (n, size)."""
        nmpc = memory.nmpc
        if self._decider is None:
            tables, rules, choice = self.nmpc.switching.tables, self.nmpc.switching.rules, NOBODY
        else:
            tables, rules = memory.tables, self._decider.rules
            choice = self._decider.arguments
        future = np.zeros(0) if self.future is None else self.future.settings
        arguments = (
            rows, memory.looked, memory.commands, memory.feet, future, self._nodes, rules,
            nmpc.bands, memory.watched, nmpc.actions, self.nmpc.problem.horizon,
            self.task.control_period, tables, nmpc.weights, *choice, self._scratch,
        )  # fmt: skip
        prepare_rows(*arguments)
        began = time.perf_counter()
        failed = self.nmpc.solve_rows(memory.looked, nmpc.weights, nmpc)
        nmpc.seconds = time.perf_counter() - began
        if nmpc.ladders or failed:
            self.nmpc.replace_failed(
                memory.looked, nmpc, np.flatnonzero(nmpc.told[:, program.CODE] != program.SUCCESS)
            )
        finish_rows(memory.watched, nmpc.told, memory.commands, nmpc.actions, future)

    def hold(self, memory: LoopMemory | None = None) -> None:
        """Let a control period pass in which nothing was computed: the last command stays."""
        held = self._memory if memory is None else memory
        if held is not None:
            held.hold()

    def diagnostics(self, memory: LoopRow) -> dict[str, Any]:
        """What `lpv-nmpc` tells of its last step for one vehicle, and what was chosen.

        `weights` (10,) are Q, S, R in use; `band` is that of the preview; `rejected` counts
        decisions of this episode that were no numbers.
        """
        batch, row = memory.memory, memory.row
        told = self.nmpc.diagnostics(batch.nmpc[row])
        if told["plan"] is not None:
            told["plan"] = moved_plan(told["plan"], batch.feet[row])
        return {
            **told,
            "weights": batch.nmpc.weights[row].copy(),
            "band": int(batch.nmpc.bands[row]),
            "rejected": int(batch.watched[row, REJECTED]),
        }


def _given(weights: str | Path | Weights) -> Weights:
    """Weights as they are, or those of a file.

    Raises
    ------
    ValueError
        For a file that is not there or cannot be used, or for anything else.
    """
    if isinstance(weights, Weights):
        return weights
    if not isinstance(weights, str | Path):
        raise ValueError(  # noqa: TRY004  as every setting that cannot be used
            "weights must be a policy of weights, a schedule, a set, or the .json of one of the "
            f"first two, not {type(weights).__name__}"
        )
    file = SHIPPED.get(str(weights), Path(weights))
    if not file.is_file():
        raise ValueError(
            f"weights {weights}: no such file; give weights= the .json of a schedule or of a "
            f"policy of weights, or as shipped: {', '.join(SHIPPED)}"
        )
    return load(file)
