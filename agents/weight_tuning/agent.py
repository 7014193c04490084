"""`lpv-nmpc-tuned`: the NMPC with weights that are chosen while it drives."""

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from agents.base import (
    CHECKPOINTS,
    Action,
    DrivingTask,
    check_compatible,
    check_vehicle,
    checked_task,
)
from agents.delay import NearFuture, moved_plan
from agents.inputs import memory_of, observation_rows, started_rows
from agents.nmpc import qp
from agents.nmpc.rti_agent import RtiNmpc
from agents.reference import NODE
from agents.weight_tuning.decision import NO_POLICY, Decider
from agents.weight_tuning.features import REJECTED
from agents.weight_tuning.loop_kernels import finish_rows, prepare_rows
from agents.weight_tuning.loop_memory import LoopMemory, LoopRow
from agents.weight_tuning.policy import WeightPolicy, load
from agents.weights import WEIGHTS, TrackingWeights, WeightSchedule, weights_from
from lpv_track_env.validation import forwards_arguments
from trajectories.arguments import flag, shortened
from trajectories.compilation import entry_point

Weights = WeightPolicy | WeightSchedule | TrackingWeights

SHIPPED = {
    "search": CHECKPOINTS / "lpv-nmpc-tuned.json",
    "paired": CHECKPOINTS / "lpv-nmpc-tuned-paired.json",
}
"""Weights that come with this project, by the method of `lpv-track tune` that found them: the best
fixed set, for any observation layout, and a policy for the default one."""


class TunedNmpc:
    """`lpv-nmpc` with weights from a weight policy, a schedule, or a fixed set.

    A policy decides once per window and at every change of band, from what the agent observes and
    does. Its actions are bit for bit those of `ClosedLoop.drive` with the same policy. Decisions
    that are not finite leave the weights as they are, all others are within the bounds of
    `WeightChoice`; failed solves are replaced as in `lpv-nmpc`.

    Parameters
    ----------
    task
        Task of the agent.
    weights
        A policy, a schedule, a set, a mapping as in `NmpcSettings`, or the .json of a policy or a
        schedule; shipped are "search", the best fixed set, and "paired", a policy.
    delay_compensation
        Predict the NMPC's observation to the time at which its action takes effect, see
        `agents.delay`; by default where the task has delays. The driving history uses the
        observations as they are.
    settings
        Keyword arguments of `RtiNmpc`, one by one, except `selection`.

    Raises
    ------
    ValueError
        For a file that cannot be used, a policy made for other observations or another control
        period than the task's, or as `RtiNmpc`.
    """

    compensates_delays: ClassVar[bool] = True
    """The class takes `delay_compensation` itself: `agents.make` does not wrap it."""

    @forwards_arguments(RtiNmpc, "selection")
    def __init__(
        self,
        settings: dict[str, Any],
        task: DrivingTask,
        *,
        weights: str | Path | Mapping[str, Any] | Weights = "search",
        delay_compensation: bool | None = None,
    ) -> None:
        self.task = checked_task(task)
        self.weights = _loaded(weights)
        policy = self.weights if isinstance(self.weights, WeightPolicy) else None
        if isinstance(self.weights, WeightSchedule):
            file = f" {weights}" if isinstance(weights, str | Path) else ""
            check_vehicle(
                f"schedule of weights{file}", task, self.weights.provenance.get("vehicle"),
                how="tuned", stacklevel=4,
            )  # fmt: skip
        if policy is not None:
            named = weights if isinstance(weights, str | Path) else repr(policy.algorithm)
            check_compatible(
                f"policy of weights {named}", task, layout=policy.layout,
                control_period=policy.control_period, vehicle=policy.training.get("vehicle"),
                stacklevel=4,
            )  # fmt: skip
        fixed = None if isinstance(self.weights, WeightPolicy) else self.weights
        self.nmpc = RtiNmpc(task, weights=fixed, **settings)
        delayed = task.delayed
        if delay_compensation is not None:
            delayed = flag("delay_compensation", delay_compensation)
        self.future = NearFuture(task, task.actuation, settings["model"]) if delayed else None
        self._decider = (
            None if policy is None else Decider(policy.choice, policy.layers, task.control_period)
        )
        widest = 1 if self._decider is None else self._decider.widest
        self._nodes = np.zeros((task.layout.preview_steps + 1, NODE))
        self._layers = np.zeros((2, widest), dtype=np.float32)
        self._memory: LoopMemory | None = None
        self._prepare: Callable[..., Any] | None = None
        self._finish: Callable[..., Any] | None = None
        # Called with zero rows to trigger compilation here, not in the first control period.
        self._blank = self._new(0)
        self._decide(np.zeros((0, task.layout.size), dtype=np.float32), self._blank)
        observation_rows(np.zeros((0, task.layout.size)), task.layout.size)

    def __getstate__(self) -> dict[str, Any]:
        # Entries of compiled functions cannot be pickled; they are made anew where needed.
        return {**self.__dict__, "_prepare": None, "_finish": None}

    def _new(self, rows: int) -> LoopMemory:
        sets = np.zeros((1, WEIGHTS)) if self._decider is None else self._decider.arrays.sets
        horizon, size = self.nmpc.problem.horizon, self.task.layout.size
        return LoopMemory(rows, horizon, size, self.future, sets)

    def reset(self) -> None:
        """Clear the memory: the next call begins new episodes."""
        self._memory = None

    def predict(
        self,
        observation: NDArray[Any],
        state: LoopMemory | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,  # noqa: ARG002  part of the protocol
    ) -> tuple[Action, LoopMemory]:
        """Return the action (2,) for one observation (size,), or (n, 2) for a batch; and memory.

        Raises
        ------
        ValueError
            If the observation does not have this agent's layout.
        TypeError
            If `state` is not the memory of such an agent.
        """
        rows = observation_rows(observation, self.task.layout.size).astype(np.float32)
        kept = self._memory
        memory = memory_of(state, kept, len(rows), self._blank, self._new)
        started = started_rows(episode_start, len(rows))
        if state is None:
            self._memory = memory
        if memory is not state and memory is not kept:
            started = list(range(len(rows)))
        for row in started:
            memory.clear(row, rows[row])
        self._decide(rows, memory)
        actions = memory.nmpc.actions.astype(np.float32)
        return (actions[0] if np.ndim(observation) == 1 else actions), memory

    def _decide(self, rows: NDArray[np.float32], memory: LoopMemory) -> None:
        """Fill `memory.nmpc.actions` for observations (n, size)."""
        nmpc, arrays, decider = memory.nmpc, memory.arrays, self._decider
        if decider is None:
            switching, policy = self.nmpc.switching, NO_POLICY
            weights = memory.weights(switching.tables, switching.rules)
        else:
            weights, policy = memory.weights(memory.tables, decider.rules), decider.arrays
        before = (
            rows, arrays, weights, policy, nmpc.actions, self._nodes, self._layers,
            self.nmpc.preview_steps, self.task.control_period,
        )  # fmt: skip
        after = (arrays, nmpc.actions, nmpc.stats)
        if self._prepare is None or self._finish is None:
            # All arrays are C-ordered and made by this class: their types never change.
            self._prepare = entry_point(prepare_rows, *before)
            self._finish = entry_point(finish_rows, *after)
        self._prepare(*before)
        began = time.perf_counter()
        failed = self.nmpc.solve_rows(memory.nmpc_observations, nmpc.weights, nmpc)
        nmpc.seconds = time.perf_counter() - began
        if nmpc.fallbacks or failed:
            self.nmpc.replace_failed(
                memory.nmpc_observations, nmpc, np.flatnonzero(nmpc.stats[:, qp.CODE] != qp.SUCCESS)
            )
        self._finish(*after)

    def hold(self, memory: LoopMemory | None = None) -> None:
        """Let a control period pass without a computation: the last command stays in force."""
        held = self._memory if memory is None else memory
        if held is not None:
            held.hold()

    def diagnostics(self, memory: LoopRow) -> dict[str, Any]:
        """Describe the last step of one vehicle: diagnostics of `lpv-nmpc` and the choice.

        `band` is the preview's; `rejected` counts the decisions of this episode that were not
        finite.
        """
        batch, row = memory.memory, memory.row
        found = self.nmpc.diagnostics(batch.nmpc[row])
        if found["plan"] is not None:
            found["plan"] = moved_plan(found["plan"], batch.foot_points[row])
        return {
            **found,
            "weights": batch.nmpc.weights[row].copy(),
            "band": int(batch.nmpc.bands[row]),
            "rejected": int(batch.history[row, REJECTED]),
        }


def _loaded(weights: str | Path | Mapping[str, Any] | Weights) -> Weights:
    """Load weights from a mapping or a file, and return others as they are.

    Anything else, or a file that cannot be used, is a ValueError.
    """
    if isinstance(weights, Weights):
        return weights
    if isinstance(weights, Mapping):
        return weights_from(weights)
    if not isinstance(weights, str | Path):
        raise ValueError(  # noqa: TRY004  one type of error for all settings
            "weights must be a policy of weights, a schedule, a set, or the .json of one of the "
            f"first two, not {type(weights).__name__}"
        )
    file = SHIPPED.get(str(weights), Path(weights))
    if not os.path.isfile(file):  # noqa: PTH113  Path.is_file raises for names that no file has
        raise ValueError(
            f"weights {shortened(weights)}: no such file; give weights= the .json of a schedule "
            f"or of a policy of weights, or as shipped: {', '.join(SHIPPED)}"
        )
    return load(file)
