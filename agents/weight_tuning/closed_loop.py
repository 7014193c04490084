"""Closed loops in compiled code: n environments, each with its NMPC and its own weights.

For tuning weights and for sweeps: one call drives every environment for a number of control
periods. The result is bit for bit that of calling the agent's `predict` and the environment's
`step` in turns, under all conditions, for any n and any number of threads.
"""

import math
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from agents.delay import DelayCompensated
from agents.nmpc.layout import working_space
from agents.nmpc.rti import NmpcArrays
from agents.nmpc.rti_agent import RtiNmpc
from agents.nmpc.schedule import NO_BAND, rules_of
from agents.reference import NODE
from agents.weight_tuning import loop_kernels as loops
from agents.weight_tuning.decision import NO_POLICY, Decider
from agents.weight_tuning.loop_memory import LoopMemory
from agents.weights import WEIGHTS
from lpv_track_env import kernels as k
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.validation import checked_threads
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vector_kernels import shares, using_threads
from trajectories import CurvatureBands

Array = NDArray[Any]


class Tally(NamedTuple):
    """Sums over a call of `ClosedLoop.drive`, an entry for each environment, (n,)."""

    steps: Array
    """Control periods driven; fewer than requested where the episode ended."""
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
    """Squared jerk of the acceleration command, (m/s^3)^2."""
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
    solves: Array


class ClosedLoop:
    """n environments, each with an NMPC of its own, driven in compiled code.

    Parameters
    ----------
    envs
        The environments, with autoreset mode DISABLED: one that has ended stands still until
        `reset(options={"reset_mask": mask})`. They define paths, vehicles and randomisation.
    agent
        `lpv-nmpc`, made for one of these environments: its problem, settings and delay
        compensation, and its weights or schedule where `drive` is given none.
    bands, slew
        Curvature bands of the weights that `drive` is given, with a set each, and the largest
        change of a weight's logarithm, 1/s. By default one set for all bands, and no limit.
    decider
        A weight policy, which chooses the weights where `drive` is given none; it has bands and
        slew of its own.
    threads
        Threads of a call, 1 by default. Results do not depend on it.

    Raises
    ------
    ValueError
        For another autoreset mode, an agent for another layout, or an impossible number of threads.
    TypeError
        For an agent other than `lpv-nmpc`, with or without delay compensation.

    Examples
    --------
    >>> envs = PathTrackingVectorEnv(64, "T2", autoreset_mode="Disabled", random_start=True)
    >>> loop = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single))
    >>> loop.reset(seed=0)
    >>> tally = loop.drive(20, weights)  # (64, 12), a set for each
    """

    def __init__(
        self,
        envs: PathTrackingVectorEnv,
        agent: RtiNmpc | DelayCompensated,
        *,
        bands: CurvatureBands | None = None,
        slew: float = math.inf,
        decider: Decider | None = None,
        threads: int = 1,
    ) -> None:
        if envs.autoreset_mode is not AutoresetMode.DISABLED:
            raise ValueError("a closed loop needs environments with autoreset_mode='Disabled'")
        if envs.single.layout != agent.task.layout:
            raise ValueError(
                f"the agent is made for {agent.task.layout}, the environments have "
                f"{envs.single.layout}: make it with agents.make(name, envs.single)"
            )
        self.envs = envs
        future = agent.future if isinstance(agent, DelayCompensated) else None
        inner = agent.agent if isinstance(agent, DelayCompensated) else agent
        if not isinstance(inner, RtiNmpc):
            raise TypeError(f"a closed loop drives with lpv-nmpc, not with {type(inner).__name__}")
        self.agent: RtiNmpc = inner
        self._decider = decider
        n, horizon, layout = envs.num_envs, inner.problem.horizon, inner.task.layout
        self.bands = CurvatureBands((), ("all",)) if bands is None else bands
        self._rules = rules_of(self.bands, 0.0, slew, envs.single.control_period)
        if decider is not None:
            self.bands, self._rules = decider.choice.bands, decider.rules
        self.memory = LoopMemory(
            n, horizon, layout.size, future,
            np.zeros((1, WEIGHTS)) if decider is None else decider.arrays.sets,
        )  # fmt: skip
        self._threads = min(checked_threads(threads), n)
        many = shares(self._threads)
        self._work = loops.Workspace(
            np.zeros((many, layout.preview_steps + 1, NODE)),
            np.zeros((many, 2, 1 if decider is None else decider.widest), dtype=np.float32),
            *working_space(horizon, many),
            np.zeros((many, filtering.WORK)),
        )

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes as the environments' own `reset` does, and clear their NMPCs' memory."""
        result = self.envs.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask", np.ones(self.envs.num_envs, dtype=np.bool_))
        for row in np.flatnonzero(mask).tolist():
            self.memory.clear(row, result[0][row])
        return result

    @property
    def running(self) -> Array:
        """Mask of the environments whose episode has not ended, (n,) bool."""
        running: Array = self.envs.arrays.ends == k.RUNNING
        return running

    def drive(
        self,
        periods: int,
        weights: ArrayLike | None = None,
        *,
        until_band: bool = False,
        trace: Array | None = None,
    ) -> Tally:
        """Drive every running environment for `periods` control periods, or to its episode's end.

        Parameters
        ----------
        periods
            At least 1.
        weights
            Q, S, R, R_rate: (12,) for all, (n, 12), or (n, bands, 12) where the loop has bands; by
            default the agent's own weights or schedule. Rows with entries that are negative or not
            finite are refused, others are clipped to the bounds of weights.
        until_band
            Stop an environment before the first solve in another band, so that it can be given
            other weights; `memory.nmpc.bands` and `memory.history` then are those of the next
            period.
        trace
            If given, filled with each environment's record after each period that it drove,
            (n, periods, `kernels.RECORD_SIZE`).

        Raises
        ------
        ValueError
            For weights of a wrong shape or value, less than one period, or a trace of another
            shape, type or memory layout.
        """
        n, periods = self.envs.num_envs, operator.index(periods)
        if periods < 1:
            raise ValueError(f"periods must be at least 1, not {periods}")
        if not self.envs.begun:
            raise gymnasium.error.ResetNeeded("the episodes have not begun: call reset() first")
        sets, rules = self._checked_weights(weights)
        if trace is None:
            trace = np.empty((n, 0, k.RECORD_SIZE))
        elif (
            trace.shape != (n, periods, k.RECORD_SIZE)
            or trace.dtype != np.float64
            or not (trace.flags.c_contiguous and trace.flags.writeable)
        ):
            raise ValueError(
                f"trace must be a writable C-ordered float64 array "
                f"{(n, periods, k.RECORD_SIZE)}, not {trace.dtype} {trace.shape}"
            )
        memory, nmpc, decider = self.memory, self.memory.nmpc, self._decider
        policy = NO_POLICY if decider is None or weights is not None else decider.arrays
        run = loops.Run(
            np.zeros(n, dtype=np.int64), np.full(n, loops.SOLVE), np.full(n, NO_BAND),
            np.zeros((n, loops.TALLY)), trace,
        )  # fmt: skip
        arguments = (
            periods, until_band, self.envs.arrays, self.envs.condition_arrays, memory.arrays,
            memory.weights(sets, rules), policy,
            NmpcArrays(self.agent.solver.constants, *nmpc.arrays), run,
        )  # fmt: skip
        while True:
            self._drive_rows(arguments)
            failed = np.flatnonzero(run.phases == loops.SOLVE_FAILED)
            if failed.size == 0:
                return Tally(*run.tally.T.copy())
            self.agent.replace_failed(memory.nmpc_observations, nmpc, failed)
            run.phases[failed] = loops.ACTION_GIVEN

    def take_in(self, mask: Array) -> None:
        """Take in the observations of environments that `mask` (n,) marks, before they drive on.

        This brings their bands and histories up to date; `drive` does the same by itself.
        """
        memory = self.memory
        loops.take_in_rows(
            mask, self.envs.arrays.observations, memory.arrays,
            memory.weights(memory.tables, self._rules), memory.nmpc.actions, self._work.nodes[0],
            self.agent.preview_steps, self.envs.single.control_period,
        )  # fmt: skip

    def _drive_rows(self, arguments: tuple[Any, ...]) -> None:
        """Drive all vehicles that are neither SOLVE_FAILED nor PAUSED, in the loop's threads."""
        n = self.envs.num_envs
        if self._threads == 1:
            own = loops.Workspace(*(space[0] for space in self._work))
            alone: Any = (0, n, *arguments, own)
            loops.drive_rows(*alone)
            return
        shared: Any = (min(len(self._work.nodes), n), n, *arguments, self._work)
        with using_threads(self._threads):
            loops.drive_in_threads(*shared)

    def copy(self, source: ArrayLike, target: ArrayLike) -> None:
        """Copy environments `source` (m,) onto environments `target` (m,), in every respect.

        Under the same weights both drive the same from there on, disturbances included.
        """
        rows, onto = np.asarray(source, dtype=np.intp), np.asarray(target, dtype=np.intp)
        self.envs.copy(rows, onto)
        self.memory.copy(rows, onto)

    def _checked_weights(self, weights: ArrayLike | None) -> tuple[Array, Array]:
        """Return tables (1 or n, bands, 12) and the rules that choose a band."""
        if weights is None and self._decider is not None:
            return self.memory.tables, self._rules
        if weights is None:
            return self.agent.switching.tables, self.agent.switching.rules
        values = np.asarray(weights, dtype=np.float64)
        n, count = self.envs.num_envs, len(self.bands)
        if values.ndim < 3:
            values = np.atleast_2d(values)
        if values.shape in {(1, WEIGHTS), (n, WEIGHTS)}:
            values = np.repeat(values[:, None], count, axis=1)
        if values.shape not in {(1, count, WEIGHTS), (n, count, WEIGHTS)}:
            tables = f" or ({n}, {count}, {WEIGHTS})" if count > 1 else ""
            raise ValueError(
                f"weights must be ({WEIGHTS},) or ({n}, {WEIGHTS}){tables}, not {np.shape(weights)}"
            )
        bad = ~(np.isfinite(values) & (values >= 0.0)).all(axis=(1, 2))
        if bad.any():
            row = int(np.argmax(bad))
            raise ValueError(f"weights of environment {row} must be finite and >= 0: {values[row]}")
        # A copy, so that arrays of any layout use the same compiled kernel.
        return np.array(values, order="C"), self._rules
