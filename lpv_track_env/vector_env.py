"""Many path tracking environments stepped at once, in compiled code."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lpv_track_env import kernels, validation, vector_kernels
from lpv_track_env.conditions import layout
from lpv_track_env.draws import random_key
from lpv_track_env.env import RESET_OPTIONS, PathTrackingEnv
from lpv_track_env.episodes import GIVEN, episode_infos, final_infos, single_info
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.plants import BICYCLE
from lpv_track_env.task import Task, action_space
from lpv_track_env.vector_kernels import ConditionArrays, EnvArrays, StepArrays
from trajectories.arguments import Whole, shown
from trajectories.compilation import entry_point
from trajectories.naming import choose

Array = NDArray[Any]
Infos = dict[str, Any]

MODES = {
    AutoresetMode.NEXT_STEP: vector_kernels.NEXT_STEP,
    AutoresetMode.SAME_STEP: vector_kernels.SAME_STEP,
    AutoresetMode.DISABLED: vector_kernels.DISABLED,
}

NUM_ENVS = Whole(1, 1_000_000)
"""Rule of the number of environments; a million take some gigabytes."""

EPISODE = 1
"""Column of an episode's number in `EnvArrays.draws`."""
NOT_BEGUN = np.uint64(2**64 - 1)
"""Number of the episode of an environment without one: the next number is 0."""


class PathTrackingVectorEnv(VectorEnv[Array, Array, Array]):
    """Many vehicles follow reference paths: `num_envs` environments `PathTrackingEnv` at once.

    `gymnasium.make_vec("lpv_track_env/PathTracking-v0", num_envs=n,
    vectorization_mode="vector_entry_point", ...)` makes one. It behaves as Gymnasium's
    `SyncVectorEnv` over single environments does, bit for bit, in a fraction of the time: actions
    (n, 2), observations (n, size) and ends as in `PathTrackingEnv`, rewards (n,) float64.

    ## Seeds

    Environment i after `reset(seed=s)` equals a single environment after `reset(seed=s + i)`, also
    in later episodes, whatever n is and in whichever order episodes end. A list of seeds gives each
    environment its own.

    ## Autoreset

    `metadata["autoreset_mode"]` is one of Gymnasium's modes:

    | mode | an environment that has ended |
    |---|---|
    | `NEXT_STEP` | begins anew in the next step: its action is ignored, its reward 0 |
    | `SAME_STEP` | begins anew at once; `infos["final_obs"]`, `infos["final_info"]` keep the end |
    | `DISABLED` | waits for `reset(options={"reset_mask": mask})`, mask (n,) bool |

    ## Infos

    Those of the single environment as arrays over environments; each `key` has a mask `_key` of the
    environments that it is valid for (the masks of one call may be the same array).

    ## Errors

    An action that is not finite or of a wrong shape or type raises a ValueError that names
    environment and entry, and leaves all episodes untouched. A step before `reset`, or in mode
    `DISABLED` of an environment that has ended, raises `gymnasium.error.ResetNeeded`.

    ## Arguments

    Those of `PathTrackingEnv` (render mode "rgb_array" only, with a frame per environment; plant
    "bicycle" only), and

    num_envs
        n, number of environments.
    trajectory, vehicle
        May be sequences, too: every reset of an environment then draws one of each, uniformly. The
        action space covers those of all vehicles; each vehicle's actuators clip to its own.
    autoreset_mode
        `gymnasium.vector.AutoresetMode` or its value.
    threads
        Threads of a step, 1 by default; more are faster from about 1000 environments on. Results
        do not depend on them. A process forked after a step with threads, such as a worker of
        Gymnasium's `AsyncVectorEnv`, goes on with one and warns of it: OpenMP allows no threads
        there. Workers started by "spawn" or "forkserver" (`context=`) keep them.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  declared so by gymnasium
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    @validation.forwards_arguments(PathTrackingEnv)
    def __init__(
        self,
        settings: dict[str, Any],
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
    ) -> None:
        self.num_envs = NUM_ENVS.of("num_envs", num_envs)
        plant = settings["plant"]
        if not isinstance(plant, str) or plant != BICYCLE:
            raise ValueError(
                f"the compiled vector environment drives plant={BICYCLE!r} only, not "
                f"{shown(plant)}: make_vec with vectorization_mode='sync' or 'async' takes every "
                "plant"
            )
        self.render_mode = settings["render_mode"]
        if self.render_mode is not None:
            choose("render_mode", self.render_mode, tuple(self.metadata["render_modes"]))
        paths = validation.listed("trajectory", settings["trajectory"])
        cars = validation.listed("vehicle", settings["vehicle"])
        self.single = PathTrackingEnv(**settings | {"trajectory": paths[0], "vehicle": cars[0]})
        """A single environment with the same settings, first path and first vehicle, for agents."""
        self.autoreset_mode = validation.checked_mode(autoreset_mode)
        self._mode = MODES[self.autoreset_mode]
        self.metadata = {**self.single.metadata, **self.metadata}
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self._threads = validation.checked_threads(threads)
        self._paths, self._cars = paths, cars
        self._drawn = (0, len(paths), len(cars))
        self.tasks = self._tasks_of(paths, cars)
        self.single_observation_space = self.single.observation_space
        self.single_action_space = action_space([task.vehicle for task in self.tasks])
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        n, size = self.num_envs, self.single.layout.size
        draws = np.zeros((n, 2), dtype=np.uint64)
        draws[:, EPISODE] = NOT_BEGUN
        nothing, given = np.zeros((0, 0)), self.single.conditions
        self.arrays = EnvArrays(
            records=np.zeros((n, kernels.RECORD_SIZE)),
            observations=np.zeros((n, size), dtype=np.float32),
            ends=np.zeros(n, dtype=np.int64),
            cases=np.zeros(n, dtype=np.int64),
            constants=nothing, tables=nothing, rows=nothing, draws=draws,
        )  # fmt: skip
        """Arrays of the current episodes, for compiled code that steps them in place."""
        self.condition_arrays: ConditionArrays | None = None
        """Further arrays under conditions; None for "simulation"."""
        final_vehicles, scratch = nothing, vector_kernels.SCRATCH_SIZE
        if given is not None:
            vehicle_size = layout.vehicle_size(given, self.single.control_period)
            self.condition_arrays = ConditionArrays(np.zeros((n, vehicle_size)), nothing)
            final_vehicles, scratch = np.zeros((n, vehicle_size)), filtering.WORK
        self._pack(self.tasks)
        self._step = StepArrays(
            commands=np.zeros((n, 2)),
            rewards=np.zeros(n),
            final_records=np.zeros((n, kernels.RECORD_SIZE)),
            final_observations=np.zeros((n, size), dtype=np.float32),
            final_vehicles=final_vehicles,
        )
        self._scratch = np.zeros((vector_kernels.shares(self._threads), scratch))
        self._advance: Callable[..., Any] | None = None
        self._begun = False
        self._nothing_given = np.full(len(GIVEN), np.nan)

    def _tasks_of(self, paths: Sequence[Any], cars: Sequence[Any]) -> list[Task]:
        """Return the task of every combination, vehicles side by side."""
        return [
            self.single.episode_task({"trajectory": path, "vehicle": car})
            for path in paths
            for car in cars
        ]

    def _pack(self, tasks: list[Task]) -> None:
        """Put the constants, tables and specs of all tasks into one array each."""
        self._packed = tasks
        tables = [tasks[0].path.table]
        rows, first = [(0, len(tables[0]))], 0
        for task in tasks[1:]:
            # Vehicles mostly share a path's table and are neighbours in the list.
            if not np.array_equal(task.path.table, tables[-1]):
                first += len(tables[-1])
                tables.append(task.path.table)
            rows.append((first, first + len(tables[-1])))
        self.arrays = self.arrays._replace(
            constants=np.stack([task.constants() for task in tasks]),
            tables=np.concatenate(tables),
            rows=np.array(rows),
        )
        if self.condition_arrays is not None:
            given = tasks[0].conditions
            assert given is not None
            friction = self.single.friction
            specs = [
                layout.spec_of(given, task.vehicle, task.control_period, friction) for task in tasks
            ]
            self.condition_arrays = self.condition_arrays._replace(specs=np.stack(specs))

    def task_of(self, index: int) -> Task:
        """Return the task of the current episode of environment `index`: its path, its vehicle."""
        return self._packed[int(self.arrays.cases[index])]

    @property
    def begun(self) -> bool:
        """True once every environment has had a reset."""
        return not (self.arrays.draws[:, EPISODE] == NOT_BEGUN).any()

    def copy(self, source: Array, target: Array) -> None:
        """Copy environments `source` (m,) onto `target` (m,): state, seeds, disturbances.

        Equal actions have equal effects from then on, until the next reset with another seed.
        """
        a = self.arrays
        for array in (a.records, a.observations, a.ends, a.cases, a.draws):
            array[target] = array[source]
        if self.condition_arrays is not None:
            self.condition_arrays.vehicles[target] = self.condition_arrays.vehicles[source]

    @property
    def records(self) -> Array:
        """Records of the current episodes, (n, `kernels.RECORD_SIZE`), not to be written."""
        return self.arrays.records

    def info_of(self, index: int) -> Infos:
        """Return the info of environment `index`, as in a single environment."""
        info = single_info(self.records[index])
        if self.condition_arrays is not None:
            info.update(layout.info_of(self.condition_arrays.vehicles[index]))
        return info

    def final_of(self, index: int) -> tuple[Infos, Array]:
        """Return the last info and observation of environment `index`, just ended in SAME_STEP."""
        record = self._step.final_records[index]
        info = single_info(record)
        if self.condition_arrays is not None:
            info.update(layout.info_of(self._step.final_vehicles[index]))
        return info, self._step.final_observations[index].copy()

    @property
    def state(self) -> Array:
        """True states [vx, vy, psi, r, X, Y], (n, 6), a copy."""
        return self.records[:, :6].copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Infos | None = None
    ) -> tuple[Array, Infos]:
        """Begin episodes of all environments, or of those that `options["reset_mask"]` marks.

        The other options are those of `PathTrackingEnv` and hold for every episode that begins.

        Raises
        ------
        ValueError, TypeError
            For an unknown or impossible option, a mask of a wrong shape or type, or seeds that are
            not one for each environment. Nothing changes then.
        """
        options = dict(options or {})
        mask = validation.checked_mask(options.pop("reset_mask", None), self.num_envs)
        for key in options:
            choose("reset option", key, RESET_OPTIONS)
        seeds = validation.checked_seeds(seed, self.num_envs)
        drawn, tasks = self._drawn, self.tasks
        if {"trajectory", "vehicle"} & set(options):
            paths = [options["trajectory"]] if "trajectory" in options else self._paths
            cars = [options["vehicle"]] if "vehicle" in options else self._cars
            tasks = self._tasks_of(paths, cars)
            drawn = (len(self.tasks), len(paths), len(cars))
        given = validation.given_start(options, min(task.path.length for task in tasks))
        for task in tasks:
            task.check_start(given)
        # All is checked: from here on the last episodes are gone.
        if isinstance(seed, int):
            super().reset(seed=seed)
        self._take_keys(seeds, mask)
        self._pack_beside(tasks if tasks is not self.tasks else [], mask)
        vector_kernels.begin_all(mask, self.arrays, self.condition_arrays, drawn, given)
        return self.arrays.observations.copy(), self._infos(mask)

    def _pack_beside(self, extra: list[Task], mask: Array) -> None:
        """Pack the constructor's tasks, `extra` ones, and those that unmarked episodes use."""
        fixed = len(self.tasks)
        used = sorted({case for case in self.arrays.cases[~mask].tolist() if case >= fixed})
        if not extra and len(self._packed) == fixed + len(used):
            return
        kept = [self._packed[case] for case in used]
        moved = {case: fixed + len(extra) + k for k, case in enumerate(used)}
        cases = self.arrays.cases
        cases[:] = [moved.get(case, min(case, fixed - 1)) for case in cases.tolist()]
        self._pack([*self.tasks, *extra, *kept])

    def _take_keys(self, seeds: Sequence[int | None], mask: Array) -> None:
        """Draw a new key for every marked environment that is seeded or has none yet."""
        draws = self.arrays.draws
        for i in np.flatnonzero(mask).tolist():
            seed = seeds[i]
            if seed is None and draws[i, EPISODE] != NOT_BEGUN:
                continue
            source = self.np_random if seed is None else seeding.np_random(seed)[0]
            draws[i] = random_key(source), NOT_BEGUN

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Drive one control period; see the class for actions, autoreset, infos and errors."""
        observations, rewards, terminated, truncated = self.advance(actions)
        infos = self._infos()
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            last = self._step
            infos.update(final_infos(last.final_records, last.final_observations, ended))
            if self.condition_arrays is not None:
                infos["final_info"].update(layout.infos_of(last.final_vehicles, ended))
        return observations, rewards, terminated, truncated, infos

    def _infos(self, mask: Array | None = None) -> Infos:
        """Return infos of the environments that `mask` (n,) marks, or of all."""
        infos = episode_infos(self.records, mask)
        if self.condition_arrays is not None:
            shown = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask
            infos.update(layout.infos_of(self.condition_arrays.vehicles, shown))
        return infos

    def advance(self, actions: Array) -> tuple[Array, Array, Array, Array]:
        """Step as `step` does, without making infos."""
        self._check_order()
        envs, step = self.arrays, self._step
        step.commands[:] = validation.checked_actions(
            actions, envs.ends, self._mode == vector_kernels.NEXT_STEP
        )
        alone = self._threads == 1
        span = (0, self.num_envs) if alone else (len(self._scratch), self.num_envs)
        scratch = self._scratch[0] if alone else self._scratch
        arguments = (
            *span, self._mode, envs, self.condition_arrays, step, self._drawn, self._nothing_given,
            scratch,
        )  # fmt: skip
        if self._advance is None:
            kernel = vector_kernels.advance if alone else vector_kernels.advance_in_threads
            self._advance = entry_point(kernel, *arguments)
        if alone:
            self._advance(*arguments)
        else:
            with vector_kernels.using_threads(self._threads):
                self._advance(*arguments)
        ended, truncated = envs.ends != kernels.RUNNING, envs.ends == kernels.TIME_LIMIT
        # Copies: a later reset or step writes into the arrays.
        return envs.observations.copy(), step.rewards.copy(), ended & ~truncated, truncated

    def _check_begun(self) -> None:
        if not self._begun:
            if not self.begun:
                raise gymnasium.error.ResetNeeded("the episodes have not begun: call reset() first")
            self._begun = True

    def _check_order(self) -> None:
        self._check_begun()
        if self.autoreset_mode is AutoresetMode.DISABLED and self.arrays.ends.any():
            index = int(np.argmax(self.arrays.ends != kernels.RUNNING))
            raise gymnasium.error.ResetNeeded(
                f"the episode of environment {index} has ended: call "
                "reset(options={'reset_mask': mask}) before step()"
            )

    def render(
        self, notes: Sequence[Mapping[str, str]] | None = None
    ) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw every environment: n frames (600, 900, 3) uint8, without trails.

        Parameters
        ----------
        notes
            Notes of each environment, as in `PathTrackingEnv.show_agent`.

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
            self.single.draw(self.task_of(i), self.records[i], None if notes is None else notes[i])
            for i in range(self.num_envs)
        )

    def close_extras(self, **_: Any) -> None:
        """Close the renderer."""
        self.single.close()

    def __getstate__(self) -> dict[str, Any]:
        # The compiled entry cannot be copied; the next step finds it again.
        return {**self.__dict__, "_advance": None}
