"""Closed loops in compiled code: n environments, each with its NMPC and its own weights.

For tuning weights and for sweeps: one call drives every environment K control periods. What happens
in each is bit for bit what `RtiNmpc.predict` and the environment's `step` would have done in turns,
whatever n is and however many threads share the work.
"""

import operator
from typing import Any, NamedTuple

import gymnasium
import numba
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from agents.nmpc import rti
from agents.nmpc.layout import working_space
from agents.nmpc.program import INNER
from agents.nmpc.rti_agent import RtiMemory, RtiNmpc
from lpv_track_env import kernels as k
from lpv_track_env.threads import checked_threads, shares, using_threads
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories.compilation import compiled, compiled_parallel

Array = NDArray[Any]

(
    STEPS, REWARD, LATERAL, HEADING, SPEED, STEERING_RATE, JERK, MAX_LATERAL, MAX_HEADING,
    STEERING_VARIATION, FAILED, CLIPPED, ITERATIONS,
) = range(13)  # fmt: skip
TALLY = 13


class Tally(NamedTuple):
    """What a call of `ClosedLoop.drive` came to, an entry an environment, (n,)."""

    steps: Array
    """Control periods driven: fewer than asked for where the episode ended."""
    reward: Array
    lateral_square: Array
    """Sum of squared lateral errors, m^2; divided by `steps`, their mean square."""
    heading_square: Array
    """rad^2."""
    speed_square: Array
    """(m/s)^2."""
    steering_rate_square: Array
    """(rad/s)^2."""
    jerk_square: Array
    """Of the acceleration command, (m/s^3)^2."""
    max_lateral: Array
    """Largest absolute lateral error, m."""
    max_heading: Array
    """rad."""
    steering_variation: Array
    """Total variation of the steering angle, rad."""
    failures: Array
    """Failed solves."""
    clipped: Array
    """Periods in which an actuator clipped its command."""
    iterations: Array
    """Interior-point iterations."""


@compiled
def drive_rows(
    first: int, last: int, periods: int, memories: Array, observations: Array, ends: Array,
    cases: Array, env_constants: Array, tables: Array, rows: Array, weights: Array,
    constants: Array, plans: Array, flags: Array, told: Array, states: Array, actions: Array,
    progress: Array, given: Array, tally: Array, trace: Array, seen: Array, stages: Array,
    lanes: Array,
) -> None:  # fmt: skip
    """Drive environments first to last - 1 until `progress` (n,) reaches `periods` or they end.

    One whose solve fails stays where it is; with `given` (n,) set it goes on with its row of
    `actions` in place of that solve. `trace` (n, periods or 0, MEMORY_SIZE) gets every memory.
    `seen` (1, size), `stages` and `lanes` are working space.
    """
    for row in range(first, last):
        memory, case = memories[row], cases[row]
        table = tables[rows[case, 0] : rows[case, 1]]
        period = env_constants[case, k.PERIOD]
        sums = tally[row]
        while progress[row] < periods and ends[row] == k.RUNNING:
            if given[row]:
                given[row] = False
            else:
                for j in range(seen.shape[1]):
                    seen[0, j] = observations[row, j]
                failed = rti.control(
                    row, seen, weights, constants, plans, flags, told, states, actions, stages,
                    lanes,
                )  # fmt: skip
                sums[ITERATIONS] += told[row, INNER]
                if failed > 0:
                    sums[FAILED] += 1.0
                    break
            before_a, before_delta = memory[k.ACCELERATION], memory[k.STEERING]
            ends[row] = k.drive(
                memory, actions[row, 0], actions[row, 1], env_constants[case], table,
                observations[row],
            )  # fmt: skip
            if trace.shape[1] > 0:
                for j in range(memory.shape[0]):
                    trace[row, progress[row], j] = memory[j]
            progress[row] += 1
            change_a = memory[k.ACCELERATION] - before_a
            change_delta = memory[k.STEERING] - before_delta
            sums[STEPS] += 1.0
            sums[REWARD] += memory[k.REWARD]
            sums[LATERAL] += memory[k.LATERAL_ERROR] * memory[k.LATERAL_ERROR]
            sums[HEADING] += memory[k.HEADING_ERROR] * memory[k.HEADING_ERROR]
            sums[SPEED] += memory[k.SPEED_ERROR] * memory[k.SPEED_ERROR]
            sums[STEERING_RATE] += change_delta * change_delta / (period * period)
            sums[JERK] += change_a * change_a / (period * period)
            sums[MAX_LATERAL] = max(sums[MAX_LATERAL], abs(memory[k.LATERAL_ERROR]))
            sums[MAX_HEADING] = max(sums[MAX_HEADING], abs(memory[k.HEADING_ERROR]))
            sums[STEERING_VARIATION] += abs(change_delta)
            if memory[k.CLIPPED] > 0.0:
                sums[CLIPPED] += 1.0


@compiled_parallel
def drive_in_threads(
    chunks: int, n: int, periods: int, memories: Array, observations: Array, ends: Array,
    cases: Array, env_constants: Array, tables: Array, rows: Array, weights: Array,
    constants: Array, plans: Array, flags: Array, told: Array, states: Array, actions: Array,
    progress: Array, given: Array, tally: Array, trace: Array, seen: Array, stages: Array,
    lanes: Array,
) -> None:  # fmt: skip
    """`drive_rows` on all n, in chunks that threads share; each has its own working space."""
    for chunk in numba.prange(chunks):
        drive_rows(
            chunk * n // chunks, (chunk + 1) * n // chunks, periods, memories, observations, ends,
            cases, env_constants, tables, rows, weights, constants, plans, flags, told,
            states, actions, progress, given, tally, trace, seen[chunk], stages[chunk],
            lanes[chunk],
        )  # fmt: skip


class ClosedLoop:
    """n environments, each with an NMPC of its own, driven in compiled code.

    Parameters
    ----------
    envs
        The environments, autoreset mode DISABLED: one that has ended stands still until
        `reset(options={"reset_mask": mask})`. Paths, vehicles and randomisation are theirs.
    agent
        The NMPC, made for such an environment: its problem, settings, and its weights where
        `drive` is given none.
    threads
        Threads of a call, 1 by default. Results do not depend on it.

    Raises
    ------
    ValueError
        For another autoreset mode, an agent for another layout, or an impossible number of threads.

    Examples
    --------
    >>> envs = PathTrackingVectorEnv(64, "T2", autoreset_mode="Disabled", random_start=True)
    >>> loop = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single))
    >>> loop.reset(seed=0)
    >>> tally = loop.drive(20, weights)  # (64, 10), a set for each
    """

    def __init__(self, envs: PathTrackingVectorEnv, agent: RtiNmpc, *, threads: int = 1) -> None:
        if envs.autoreset_mode is not AutoresetMode.DISABLED:
            raise ValueError("a closed loop needs environments with autoreset_mode='Disabled'")
        if envs.single.conditions is not None:
            raise ValueError(
                "a closed loop in compiled code knows conditions 'simulation' only: step the "
                "environments and let the agent predict"
            )
        if envs.single.layout != agent.task.layout:
            raise ValueError(
                f"the agent is made for {agent.task.layout}, the environments have "
                f"{envs.single.layout}: make it with agents.make(name, envs.single)"
            )
        self.envs, self.agent = envs, agent
        n = envs.num_envs
        self.memory = RtiMemory(n, agent.problem.horizon)
        self._threads = min(checked_threads(threads), n)
        self._work = (
            np.zeros((shares(self._threads), 1, agent.task.layout.size)),
            *working_space(agent.problem.horizon, shares(self._threads)),
        )

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes as the environments' own `reset` does; their NMPCs forget."""
        result = self.envs.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask", np.ones(self.envs.num_envs, dtype=np.bool_))
        for row in np.flatnonzero(mask).tolist():
            self.memory.clear(row)
        return result

    @property
    def running(self) -> Array:
        """Environments whose episode goes on, (n,) bool."""
        running: Array = self.envs.arrays.ends == k.RUNNING
        return running

    def drive(
        self, periods: int, weights: ArrayLike | None = None, *, trace: Array | None = None
    ) -> Tally:
        """Drive every running environment `periods` control periods, or to its episode's end.

        Parameters
        ----------
        periods
            At least 1.
        weights
            Q, S, R, (10,) for all or (n, 10); by default the agent's own. Rows that are not finite
            or negative are refused.
        trace
            Filled if given, (n, periods, `kernels.MEMORY_SIZE`): each environment's memory after
            each period that it drove.

        Raises
        ------
        ValueError
            For weights of a wrong shape or value, less than one period, or an array to trace into
            of a wrong kind.
        """
        n, periods = self.envs.num_envs, operator.index(periods)
        if periods < 1:
            raise ValueError(f"periods must be at least 1, not {periods}")
        if not self.envs.begun:
            raise gymnasium.error.ResetNeeded("the episodes have not begun: call reset() first")
        sets = self._checked_weights(weights)
        if trace is None:
            trace = np.empty((n, 0, k.MEMORY_SIZE))
        elif (
            trace.shape != (n, periods, k.MEMORY_SIZE)
            or trace.dtype != np.float64
            or not (trace.flags.c_contiguous and trace.flags.writeable)
        ):
            raise ValueError(
                f"trace must be a writable C-ordered float64 array "
                f"{(n, periods, k.MEMORY_SIZE)}, not {trace.dtype} {trace.shape}"
            )
        progress, given = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.bool_)
        tally = np.zeros((n, TALLY))
        memory, arrays = self.memory, self.envs.arrays
        arguments = (
            periods, *arrays, sets, self.agent.solver.constants, memory.plans, memory.flags,
            memory.told, memory.states, memory.actions, progress, given,
            tally, trace,
        )  # fmt: skip
        while True:
            if self._threads == 1:
                drive_rows(0, n, *arguments, *(space[0] for space in self._work))
            else:
                with using_threads(self._threads):
                    drive_in_threads(min(len(self._work[0]), n), n, *arguments, *self._work)
            stuck = np.flatnonzero((arrays.ends == k.RUNNING) & (progress < periods))
            if stuck.size == 0:
                return Tally(*tally.T.copy())
            self.agent.replace_failed(arrays.observations.astype(np.float64), memory, stuck)
            given[stuck] = True

    def _checked_weights(self, weights: ArrayLike | None) -> Array:
        if weights is None:
            if self.agent.has_schedule:
                raise ValueError(
                    "the agent's weights come from a schedule, which predict follows: give drive "
                    "its weights"
                )
            return self.agent.fixed_weights
        values = np.atleast_2d(np.asarray(weights, dtype=np.float64))
        n = self.envs.num_envs
        if values.shape not in {(1, 10), (n, 10)}:
            raise ValueError(f"weights must be (10,) or ({n}, 10), not {np.shape(weights)}")
        bad = ~(np.isfinite(values) & (values >= 0.0)).all(axis=1)
        if bad.any():
            row = int(np.argmax(bad))
            raise ValueError(f"weights of environment {row} must be finite and >= 0: {values[row]}")
        # A copy: one compiled form takes it, whatever array it came in.
        return np.array(values, order="C")
