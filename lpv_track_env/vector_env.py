"""Many path tracking environments stepped at once, in compiled code."""

import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lpv_track_env import kernels, vector_kernels
from lpv_track_env.conditions import Conditions
from lpv_track_env.conditions.vector import ConditionsVector
from lpv_track_env.draws import random_key
from lpv_track_env.env import RESET_OPTIONS, PathTrackingEnv
from lpv_track_env.episodes import GIVEN, given_start
from lpv_track_env.plants import BICYCLE
from lpv_track_env.reward import RewardWeights
from lpv_track_env.task import Task, action_space
from lpv_track_env.threads import checked_threads, shares, using_threads
from lpv_track_env.vector_checks import (
    checked_actions,
    checked_mask,
    checked_mode,
    checked_seeds,
    listed,
)
from lpv_track_env.vector_infos import episode_infos, final_infos, single_info
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.naming import choose

Array = NDArray[Any]
Infos = dict[str, Any]

MODES = {
    AutoresetMode.NEXT_STEP: vector_kernels.NEXT_STEP,
    AutoresetMode.SAME_STEP: vector_kernels.SAME_STEP,
    AutoresetMode.DISABLED: vector_kernels.DISABLED,
}


class KernelArrays(NamedTuple):
    """What the kernels know of n environments: see `kernels` for records and constants."""

    records: Array
    """(n, RECORD_SIZE)."""
    observations: Array
    """(n, size) float32."""
    ends: Array
    """(n,) codes of `kernels.END_NAMES`."""
    cases: Array
    """(n,) index of each environment's constants and table."""
    constants: Array
    """(cases, CONSTANTS_SIZE)."""
    tables: Array
    """(nodes, 8), all paths one after another."""
    rows: Array
    """(cases, 2), first row of each table and the one after its last."""


class PathTrackingVectorEnv(VectorEnv[Array, Array, Array]):
    """`num_envs` vehicles follow reference paths: `PathTrackingEnv`, many at once.

    `gymnasium.make_vec("lpv_track_env/PathTracking-v0", num_envs=n,
    vectorization_mode="vector_entry_point", ...)` makes one. It behaves as Gymnasium's
    `SyncVectorEnv` over single environments does, bit for bit, in a fraction of the time: actions
    (n, 2), observations (n, size) and ends as in `PathTrackingEnv`, rewards (n,) float64.

    ## Seeds

    Environment i of `reset(seed=s)` is a single environment of `reset(seed=s + i)`, also over the
    episodes that follow, whatever n is and in which order they end. A list gives each its own.

    ## Autoreset

    `metadata["autoreset_mode"]` says which of Gymnasium's modes holds:

    | mode | an environment that has ended |
    |---|---|
    | `NEXT_STEP` | begins anew in the next step: its action is ignored, its reward 0 |
    | `SAME_STEP` | begins anew at once; `infos["final_obs"]`, `infos["final_info"]` keep the end |
    | `DISABLED` | waits for `reset(options={"reset_mask": mask})`, mask (n,) bool |

    ## Infos

    Those of the single environment as arrays over environments, `reward_terms` a dictionary of
    them; each `key` with a mask `_key` of the environments that it holds for (masks of one call
    may be one array). `end` only in steps in which an episode ended.

    ## Errors

    An action that is not finite, of a wrong shape or type, is a ValueError that names environment
    and entry, and leaves all episodes untouched. A step before `reset`, or in mode `DISABLED` of an
    environment that has ended, is a `gymnasium.error.ResetNeeded`.

    ## Arguments

    Those of `PathTrackingEnv` (rendering: "rgb_array" only, a frame an environment; plant:
    "bicycle" only), and

    num_envs
        n, number of environments.
    trajectory, vehicle
        May be sequences too: every reset of an environment then draws one of each, uniformly. The
        action space is the widest of the vehicles'; each vehicle's actuators clip to its own.
    autoreset_mode
        `gymnasium.vector.AutoresetMode` or its value.
    threads
        Threads of a step, 1 by default; more pay from some 1000 environments on. Results do not
        depend on it.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  declared so by gymnasium
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        trajectory: str | Path | ReferencePath | Sequence[str | Path | ReferencePath] = "T1",
        vehicle: str | Path | VehicleParameters | Sequence[str | Path | VehicleParameters] = (
            "m2-minibus"
        ),
        speed_mode: str = "variable",
        fixed_speed: float | None = None,
        conditions: str | Conditions | dict[str, Any] = "simulation",
        control_period: float = 0.05,
        render_mode: str | None = None,
        *,
        preview_steps: int = 20,
        preview_period: float | None = None,
        reward_weights: RewardWeights | None = None,
        max_lateral_error: float = 5.0,
        time_limit: float | None = None,
        initial_error_range: tuple[float, float, float] = (0.0, 0.0, 0.0),
        random_start: bool = False,
        plant: str = BICYCLE,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
    ) -> None:
        if operator.index(num_envs) < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        if plant != BICYCLE:
            raise ValueError(
                f"the compiled vector environment drives plant={BICYCLE!r} only, not {plant!r}: "
                "make_vec with vectorization_mode='sync' or 'async' takes every plant"
            )
        if render_mode is not None:
            choose("render_mode", render_mode, tuple(self.metadata["render_modes"]))
        paths: list[str | Path | ReferencePath] = listed("trajectory", trajectory)
        cars: list[str | Path | VehicleParameters] = listed("vehicle", vehicle)
        self.num_envs = operator.index(num_envs)
        self.render_mode = render_mode
        self._single = PathTrackingEnv(
            paths[0], cars[0], speed_mode, fixed_speed, conditions, control_period,
            render_mode=render_mode, preview_steps=preview_steps, preview_period=preview_period,
            reward_weights=reward_weights, max_lateral_error=max_lateral_error,
            time_limit=time_limit, initial_error_range=initial_error_range,
            random_start=random_start,
        )  # fmt: skip
        self.autoreset_mode = checked_mode(autoreset_mode)
        self._mode = MODES[self.autoreset_mode]
        self.metadata = {**self._single.metadata, **self.metadata}
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self._threads = checked_threads(threads)
        self._paths, self._cars = paths, cars
        self._drawn = (0, len(paths), len(cars))
        self.tasks = self._tasks_of(paths, cars)
        self._conditioned: ConditionsVector | None = None
        if (given := self._single.conditions) is not None:
            self._conditioned = ConditionsVector(
                given, self.num_envs, self._single.control_period, self._threads
            )
        self._pack(self.tasks)
        self.single_observation_space = self._single.observation_space
        self.single_action_space = action_space([task.vehicle for task in self.tasks])
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        n, size = self.num_envs, self._single.layout.size
        self._records = np.zeros((n, kernels.RECORD_SIZE))
        self._final_records = np.zeros((n, kernels.RECORD_SIZE))
        self._observations = np.zeros((n, size), dtype=np.float32)
        self._final_observations = np.zeros((n, size), dtype=np.float32)
        self._scratch = np.zeros((shares(self._threads), vector_kernels.SCRATCH_SIZE))
        self._cases = np.zeros(n, dtype=np.int64)
        self._keys = np.zeros(n, dtype=np.uint64)
        self._episodes = np.full(n, -1)
        self._ends = np.zeros(n, dtype=np.int64)
        self._begun = False
        self._nothing_given = np.full(len(GIVEN), np.nan)

    def _tasks_of(self, paths: Sequence[Any], cars: Sequence[Any]) -> list[Task]:
        """Return the task of every combination, vehicles side by side."""
        return [
            self._single.episode_task({"trajectory": path, "vehicle": car})
            for path in paths
            for car in cars
        ]

    def _pack(self, tasks: list[Task]) -> None:
        """Put the constants and the tables of all tasks into one array each."""
        self._packed = tasks
        self._constants = np.stack([task.constants() for task in tasks])
        tables = [tasks[0].path.table]
        rows, first = [(0, len(tables[0]))], 0
        for task in tasks[1:]:
            # Vehicles mostly share a path's table, and they stand beside one another in the list.
            if not np.array_equal(task.path.table, tables[-1]):
                first += len(tables[-1])
                tables.append(task.path.table)
            rows.append((first, first + len(tables[-1])))
        self._tables, self._rows = np.concatenate(tables), np.array(rows)
        if self._conditioned is not None:
            self._conditioned.pack(tasks)

    def task_of(self, index: int) -> Task:
        """Task of the current episode of environment `index`: its path, its vehicle."""
        return self._packed[int(self._cases[index])]

    @property
    def begun(self) -> bool:
        """Whether every environment has had a reset."""
        return bool(self._episodes.min() >= 0)

    def copy(self, source: Array, target: Array) -> None:
        """Make environments `target` (m,) those that `source` (m,) are: state, seeds, disturbances.

        From there on the same actions lead to the same, until the next reset with another seed.
        """
        for array in (
            self._records, self._observations, self._ends, self._cases, self._keys, self._episodes,
        ):  # fmt: skip
            array[target] = array[source]
        if self._conditioned is not None:
            self._conditioned.vehicles[target] = self._conditioned.vehicles[source]

    @property
    def single(self) -> PathTrackingEnv:
        """A single environment of the same settings, the first path and vehicle: for agents."""
        return self._single

    @property
    def arrays(self) -> KernelArrays:
        """Arrays of the current episodes, not copies, for compiled code that steps them itself."""
        return KernelArrays(
            self._records, self._observations, self._ends, self._cases, self._constants,
            self._tables, self._rows,
        )  # fmt: skip

    @property
    def condition_arrays(self) -> tuple[Array, Array, Array] | None:
        """The same of what conditions add: vehicles (n, size), specs (cases, SPEC), draws (n, 2).

        See `conditions_layout`; None under conditions `simulation`.
        """
        if self._conditioned is None:
            return None
        return self._conditioned.arrays(self._keys, self._episodes)

    @property
    def records(self) -> Array:
        """Records of the current episodes, (n, `kernels.RECORD_SIZE`), to read."""
        return self._records

    def info_of(self, index: int) -> Infos:
        """Info of environment `index`, as the single environment gives it, without its end."""
        info = single_info(self._records[index])
        if self._conditioned is not None:
            info.update(self._conditioned.single_info(index))
        return info

    def final_of(self, index: int) -> tuple[Infos, Array]:
        """Last info and observation of environment `index`, which just ended in SAME_STEP."""
        record = self._final_records[index]
        info = {**single_info(record), "end": kernels.END_NAMES[int(record[kernels.END])]}
        if self._conditioned is not None:
            info.update(self._conditioned.final_info(index))
        return info, self._final_observations[index].copy()

    @property
    def state(self) -> Array:
        """True states [vx, vy, psi, r, X, Y], (n, 6), a copy."""
        return self._records[:, :6].copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Infos | None = None
    ) -> tuple[Array, Infos]:
        """Begin episodes: of all environments, or of those that `options["reset_mask"]` marks.

        The other options are those of `PathTrackingEnv` and hold for every episode that begins.

        Raises
        ------
        ValueError, TypeError
            For an unknown or impossible option, a mask of a wrong shape or type, or seeds that are
            not one for each environment. Nothing is changed then.
        """
        options = dict(options or {})
        mask = checked_mask(options.pop("reset_mask", None), self.num_envs)
        for key in options:
            choose("reset option", key, RESET_OPTIONS)
        seeds = checked_seeds(seed, self.num_envs)
        drawn, tasks = self._drawn, self.tasks
        if {"trajectory", "vehicle"} & set(options):
            paths = [options["trajectory"]] if "trajectory" in options else self._paths
            cars = [options["vehicle"]] if "vehicle" in options else self._cars
            tasks = self._tasks_of(paths, cars)
            drawn = (len(self.tasks), len(paths), len(cars))
        given = given_start(options, min(task.path.length for task in tasks))
        # All is checked: from here on the last episodes are gone.
        if isinstance(seed, int):
            super().reset(seed=seed)
        self._take_keys(seeds, mask)
        self._pack_beside(tasks if tasks is not self.tasks else [], mask)
        if self._conditioned is None:
            vector_kernels.begin_all(
                mask, self._records, self._cases, drawn, self._constants, self._tables,
                self._rows, self._keys, self._episodes, given, self._observations, self._ends,
            )  # fmt: skip
        else:
            self._conditioned.begin(
                mask, self._keys, self._episodes,
                (
                    self._records, self._cases, drawn, self._constants, self._tables, self._rows,
                    given, self._observations, self._ends,
                ),
            )  # fmt: skip
        infos = episode_infos(self._records, mask)
        if self._conditioned is not None:
            infos.update(self._conditioned.infos(mask))
        return self._observations.copy(), infos

    def _pack_beside(self, extra: list[Task], mask: Array) -> None:
        """Pack the constructor's tasks, `extra` ones, and what unmarked episodes still use."""
        fixed = len(self.tasks)
        used = sorted({case for case in self._cases[~mask].tolist() if case >= fixed})
        if not extra and len(self._packed) == fixed + len(used):
            return
        kept = [self._packed[case] for case in used]
        moved = {case: fixed + len(extra) + k for k, case in enumerate(used)}
        self._cases[:] = [moved.get(case, min(case, fixed - 1)) for case in self._cases.tolist()]
        self._pack([*self.tasks, *extra, *kept])

    def _take_keys(self, seeds: Sequence[int | None], mask: Array) -> None:
        """Give every environment that begins a new key where it is seeded or has none yet."""
        for i in np.flatnonzero(mask).tolist():
            seed = seeds[i]
            if seed is None and self._episodes[i] >= 0:
                continue
            source = self.np_random if seed is None else seeding.np_random(seed)[0]
            self._keys[i] = random_key(source)
            self._episodes[i] = -1

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Drive one control period; see the class for actions, autoreset, infos and errors."""
        observations, rewards, terminated, truncated = self.advance(actions)
        infos = episode_infos(self._records)
        ended = terminated | truncated
        if self._conditioned is not None:
            infos.update(self._conditioned.infos(np.ones(self.num_envs, dtype=np.bool_)))
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            infos.update(final_infos(self._final_records, self._final_observations, ended))
            if self._conditioned is not None:
                infos["final_info"].update(self._conditioned.final_infos(ended))
        return observations, rewards, terminated, truncated, infos

    def advance(self, actions: Array) -> tuple[Array, Array, Array, Array]:
        """`step` without infos, for those who do not read them."""
        self._check_order()
        commands = checked_actions(actions, self._ends, self._mode)
        n = self.num_envs
        rewards = np.empty(n)
        if self._conditioned is not None:
            self._conditioned.advance(
                self._mode, self._keys, self._episodes,
                (
                    self._records, commands, self._cases, self._drawn, self._constants,
                    self._tables, self._rows, self._nothing_given, self._observations, self._ends,
                    rewards, self._final_records, self._final_observations,
                ),
            )  # fmt: skip
            return self._outcome(rewards)
        arguments = (
            self._mode, self._records, commands, self._cases, self._drawn, self._constants,
            self._tables, self._rows, self._keys, self._episodes, self._nothing_given,
            self._observations, self._ends, rewards, self._final_records, self._final_observations,
        )  # fmt: skip
        if self._threads == 1:
            vector_kernels.advance(0, n, *arguments, self._scratch[0])
        else:
            with using_threads(self._threads):
                chunks = len(self._scratch)
                vector_kernels.advance_in_threads(chunks, n, *arguments, self._scratch)
        return self._outcome(rewards)

    def _outcome(self, rewards: Array) -> tuple[Array, Array, Array, Array]:
        ended = self._ends != kernels.RUNNING
        truncated = self._ends == kernels.TIME_LIMIT
        # A copy: a reset of some environments hands out the others' observations again.
        return self._observations.copy(), rewards, ended & ~truncated, truncated

    def _check_begun(self) -> None:
        if not self._begun:
            if self._episodes.min() < 0:
                raise gymnasium.error.ResetNeeded("the episodes have not begun: call reset() first")
            self._begun = True

    def _check_order(self) -> None:
        self._check_begun()
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ends.any():
            raise gymnasium.error.ResetNeeded(
                f"the episode of environment {int(np.argmax(self._ends != 0))} has ended: call "
                "reset(options={'reset_mask': mask}) before step()"
            )

    def render(
        self, notes: Sequence[Mapping[str, str]] | None = None
    ) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw every environment: n frames (600, 900, 3) uint8, without trails.

        Parameters
        ----------
        notes
            Of each environment, as in `PathTrackingEnv.show_agent`.

        Raises
        ------
        ResetNeeded
            Before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array'")
            return None
        self._check_begun()
        return tuple(
            self._single.draw(
                self.task_of(i), self._records[i], None if notes is None else notes[i]
            )
            for i in range(self.num_envs)
        )

    def close_extras(self, **_: Any) -> None:
        """Free what drawing took."""
        self._single.close()
