"""Many vehicles under conditions: what `PathTrackingVectorEnv` needs beside its own arrays."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels as k
from lpv_track_env.conditions import Conditions, layout
from lpv_track_env.conditions.episode import begin_under_conditions, drive_under_conditions
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.task import Task
from lpv_track_env.threads import shares, using_threads
from lpv_track_env.vector_kernels import NEXT_STEP, SAME_STEP, copy, draw_case
from trajectories.compilation import compiled, compiled_internal, compiled_parallel

Array = NDArray[Any]


@compiled_internal
def begin_next(
    i: int, m: Array, record: Array, cases: Array, drawn: Any, specs: Array, constants: Array,
    tables: Array, rows: Array, observation: Array, draws: Array, given: Array,
) -> None:  # fmt: skip
    """`vector_kernels.begin_next` under conditions; `draws` holds key and episode, (2,)."""
    draws[1] += np.uint64(1)
    case = draw_case(drawn, draws[0], draws[1])
    cases[i] = case
    table = tables[rows[case, 0] : rows[case, 1]]
    begin_under_conditions(
        m, record, specs[case], constants[case], table, observation, draws, given
    )


@compiled
def advance(
    first: int, last: int, mode: int,
    records: Array, actions: Array, cases: Array, drawn: Any, constants: Array, tables: Array,
    rows: Array, given: Array, observations: Array, ends: Array, rewards: Array,
    final_records: Array, final_observations: Array,
    vehicles: Array, specs: Array, draws: Array, final_reports: Array, work: Array,
) -> None:  # fmt: skip
    """One control period of the environments `first` to `last` - 1, as `vector_kernels.advance`.

    `vehicles` (n, size) and `specs` (cases, SPEC) are as `conditions_layout` has them; `draws`
    (n, 2) uint64 key and episode of each; `work` is the filter's.
    """
    for i in range(first, last):
        record, observation, m = records[i], observations[i], vehicles[i]
        begins = mode == NEXT_STEP and ends[i] != k.RUNNING
        if begins:
            ends[i], rewards[i] = k.RUNNING, 0.0
        else:
            case = cases[i]
            ends[i] = drive_under_conditions(
                m, record, actions[i, 0], actions[i, 1], specs[case], constants[case],
                tables[rows[case, 0] : rows[case, 1]], observation, draws[i, 0], draws[i, 1], work,
            )  # fmt: skip
            rewards[i] = record[k.REWARD]
            if mode == SAME_STEP and ends[i] != k.RUNNING:
                begins = True
                copy(record, final_records[i])
                copy(observation, final_observations[i])
                for j in range(6):
                    final_reports[i, j] = m[layout.ESTIMATE + j]
                final_reports[i, 6] = m[layout.DEVIATION]
                final_reports[i, 7], final_reports[i, 8] = m[layout.STOPPING], m[layout.MISSES]
        if begins:
            begin_next(
                i, m, record, cases, drawn, specs, constants, tables, rows, observation,
                draws[i], given,
            )  # fmt: skip


@compiled_parallel
def advance_in_threads(
    chunks: int, n: int, mode: int,
    records: Array, actions: Array, cases: Array, drawn: Any, constants: Array, tables: Array,
    rows: Array, given: Array, observations: Array, ends: Array, rewards: Array,
    final_records: Array, final_observations: Array,
    vehicles: Array, specs: Array, draws: Array, final_reports: Array, work: Array,
) -> None:  # fmt: skip
    """`advance` on all n environments, in chunks that threads share, each with a row of `work`."""
    for chunk in numba.prange(chunks):
        advance(
            chunk * n // chunks, (chunk + 1) * n // chunks, mode, records, actions, cases, drawn,
            constants, tables, rows, given, observations, ends, rewards, final_records,
            final_observations, vehicles, specs, draws, final_reports, work[chunk],
        )  # fmt: skip


@compiled
def begin_all(
    mask: Array, records: Array, cases: Array, drawn: Any, constants: Array, tables: Array,
    rows: Array, given: Array, observations: Array, ends: Array, vehicles: Array, specs: Array,
    draws: Array,
) -> None:  # fmt: skip
    """Begin the next episode of every environment that `mask` (n,) marks."""
    for i in range(mask.shape[0]):
        if mask[i]:
            ends[i] = k.RUNNING
            begin_next(
                i, vehicles[i], records[i], cases, drawn, specs, constants, tables, rows,
                observations[i], draws[i], given,
            )  # fmt: skip


class ConditionsVector:
    """Arrays of n vehicles under conditions, and the kernels on them.

    Parameters
    ----------
    conditions
        Of every vehicle; each draws its own.
    num_envs
        n.
    period
        Control period, s.
    threads
        Of a step.
    """

    def __init__(self, conditions: Conditions, num_envs: int, period: float, threads: int) -> None:
        self._conditions, self._period, self._threads = conditions, period, threads
        self.vehicles = np.zeros((num_envs, layout.vehicle_size(conditions, period)))
        self.draws = np.zeros((num_envs, 2), dtype=np.uint64)
        self._final_reports = np.zeros((num_envs, len(layout.REPORTED)))
        self._work = np.zeros((shares(threads), filtering.WORK))
        self.specs = np.zeros((0, layout.SPEC))

    def pack(self, tasks: Sequence[Task]) -> None:
        """Take the specs of all tasks."""
        self.specs = np.stack(
            [layout.spec_of(self._conditions, task.vehicle, self._period) for task in tasks]
        )

    def arrays(self, keys: Array, episodes: Array) -> tuple[Array, Array, Array]:
        """Vehicles, specs and draws as `drive_under_conditions` takes them, not copies."""
        self.draws[:, 0], self.draws[:, 1] = keys, episodes
        return self.vehicles, self.specs, self.draws

    def advance(self, mode: int, keys: Array, episodes: Array, arguments: Any) -> None:
        """Drive a control period; `arguments` are `advance`'s from `records` on."""
        self.draws[:, 0], self.draws[:, 1] = keys, episodes
        n = len(self.draws)
        shared = (mode, *arguments, self.vehicles, self.specs, self.draws, self._final_reports)
        if self._threads == 1:
            alone: Any = (0, n, *shared, self._work[0])
            advance(*alone)
        else:
            chunked: Any = (len(self._work), n, *shared, self._work)
            with using_threads(self._threads):
                advance_in_threads(*chunked)
        episodes[:] = self.draws[:, 1]

    def begin(self, mask: Array, keys: Array, episodes: Array, arguments: Any) -> None:
        """Begin the next episodes of those marked; `arguments` are those of `begin_all`."""
        self.draws[:, 0] = keys
        # -1, before the first episode, becomes the largest number, and 0 with the next.
        self.draws[:, 1] = episodes.astype(np.uint64)
        given: Any = (mask, *arguments, self.vehicles, self.specs, self.draws)
        begin_all(*given)
        episodes[mask] = self.draws[mask, 1].astype(episodes.dtype)

    def infos(self, mask: Array) -> dict[str, Any]:
        """Infos of the vehicles that `mask` (n,) marks."""
        return layout.reports_infos(self.vehicles[:, layout.REPORTED], mask)

    def final_infos(self, ended: Array) -> dict[str, Any]:
        """Infos of the episodes that have `ended` (n,) in the last step, in SAME_STEP."""
        return layout.reports_infos(self._final_reports, ended)

    def single_info(self, index: int) -> dict[str, Any]:
        """Infos of one vehicle."""
        return layout.single_report(self.vehicles[index, list(layout.REPORTED)])

    def final_info(self, index: int) -> dict[str, Any]:
        """Infos of one vehicle's episode that has just ended, in SAME_STEP."""
        return layout.single_report(self._final_reports[index])
