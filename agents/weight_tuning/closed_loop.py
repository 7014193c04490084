"""Closed loops in compiled code: n environments, each with its NMPC and its own weights.

For tuning weights and for sweeps: one call drives every environment K control periods. What happens
in each is bit for bit what the agent's `predict` and the environment's `step` would have done in
turns, under every kind of conditions, whatever n is and however many threads share the work.
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
from agents.nmpc.rti_agent import RtiNmpc
from agents.nmpc.schedule import NO_BAND, rules_of
from agents.reference import NODE
from agents.weight_tuning import loop_kernels as loops
from agents.weight_tuning.deciding import NOBODY, Decider
from agents.weight_tuning.loop_memory import LoopMemory
from lpv_track_env import kernels as k
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.validation import checked_threads
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vector_kernels import shares, using_threads
from trajectories import CurvatureBands

Array = NDArray[Any]


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
    solves: Array


class ClosedLoop:
    """n environments, each with an NMPC of its own, driven in compiled code.

    Parameters
    ----------
    envs
        The environments, autoreset mode DISABLED: one that has ended stands still until
        `reset(options={"reset_mask": mask})`. Paths, vehicles and randomisation are theirs.
    agent
        `lpv-nmpc`, made for such an environment: its problem, settings, delay compensation, and its
        weights or schedule where `drive` is given none.
    bands, slew
        Of weights that `drive` is given: bands of curvature with a set each, and the largest change
        of a weight's logarithm, 1/s. By default one set for all, and no limit.
    decider
        A weight policy at work: it chooses the weights where `drive` is given none; bands and slew
        are its own.
    threads
        Threads of a call, 1 by default. Results do not depend on it.

    Raises
    ------
    ValueError
        For another autoreset mode, an agent for another layout, or an impossible number of threads.
    TypeError
        For an agent that is not `lpv-nmpc`, with delay compensation around it or not.

    Examples
    --------
    >>> envs = PathTrackingVectorEnv(64, "T2", autoreset_mode="Disabled", random_start=True)
    >>> loop = ClosedLoop(envs, agents.make("lpv-nmpc", envs.single))
    >>> loop.reset(seed=0)
    >>> tally = loop.drive(20, weights)  # (64, 10), a set for each
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
            np.zeros((1, 10)) if decider is None else decider.packed.sets,
        )  # fmt: skip
        self._threads = min(checked_threads(threads), n)
        self._future = future.settings if future is not None else np.zeros(0)
        many = shares(self._threads)
        self._work = (
            np.zeros((many, layout.preview_steps + 1, NODE)),
            np.zeros((many, 2, 1 if decider is None else decider.widest), dtype=np.float32),
            *working_space(horizon, many),
        )
        self._filter_work = np.zeros((many, filtering.WORK))

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes as the environments' own `reset` does; their NMPCs forget."""
        result = self.envs.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask", np.ones(self.envs.num_envs, dtype=np.bool_))
        for row in np.flatnonzero(mask).tolist():
            self.memory.clear(row, result[0][row])
        return result

    @property
    def running(self) -> Array:
        """Environments whose episode goes on, (n,) bool."""
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
        """Drive every running environment `periods` control periods, or to its episode's end.

        Parameters
        ----------
        periods
            At least 1.
        weights
            Q, S, R: (10,) for all, (n, 10), or (n, bands, 10) where the loop has bands; by default
            the agent's own, its schedule's too. Rows that are not finite or negative are refused,
            others brought within the bounds of weights.
        until_band
            Whether an environment stops before the first solve in which its band is another, so
            that it may be given other weights; `memory.nmpc.bands` and
            `memory.watched` are those of the next period then.
        trace
            Filled if given, (n, periods, `kernels.RECORD_SIZE`): each environment's memory after
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
        since, progress, asked = (
            np.full(n, NO_BAND),
            np.zeros(n, dtype=np.int64),
            np.full(n, loops.ASKED),
        )
        tally = np.zeros((n, loops.TALLY))
        memory, nmpc, arrays = self.memory, self.memory.nmpc, self.envs.arrays
        arguments = (
            periods, *arrays[:-1], memory.looked, memory.commands, memory.feet, self._future, sets,
            rules, nmpc.bands, nmpc.weights, memory.watched, until_band, since,
            *(NOBODY if self._decider is None or weights is not None else self._decider.arguments),
            self.agent.solver.constants, nmpc.plans, nmpc.flags, nmpc.told, nmpc.states,
            nmpc.actions, progress, asked, tally, trace,
        )  # fmt: skip
        while True:
            self._call(arguments)
            stuck = np.flatnonzero(asked == loops.HELD)
            if stuck.size == 0:
                return Tally(*tally.T.copy())
            self.agent.replace_failed(memory.looked, nmpc, stuck)
            asked[stuck] = loops.GIVEN

    def attend(self, mask: Array) -> None:
        """Take in the observations of environments that `mask` (n,) marks, before they drive on.

        Bands and what is watched are up to date then; `drive` does the same by itself.
        """
        memory, arrays = self.memory, self.envs.arrays
        loops.attend_rows(
            mask, arrays.observations, memory.looked, memory.commands, memory.feet, self._future,
            self._work[0][0], self._rules, memory.nmpc.bands, memory.watched, memory.nmpc.actions,
            self.agent.problem.horizon, self.envs.single.control_period,
        )  # fmt: skip

    def _call(self, arguments: tuple[Any, ...]) -> None:
        """Drive all that are not HELD or PAUSED, in threads if the loop has them."""
        n, given = self.envs.num_envs, self.envs.condition_arrays
        work = (*self._work, *(() if given is None else (self._filter_work,)))
        kernel: Any = loops.drive_rows if given is None else loops.drive_rows_under_conditions
        more = () if given is None else (*given, self.envs.arrays.draws)
        spaces = len(self._work)
        if self._threads == 1:
            own = [space[0] for space in work]
            kernel(0, n, *arguments, *own[:spaces], *more, *own[spaces:])
            return
        many: Any = (
            loops.drive_in_threads if given is None else loops.drive_in_threads_under_conditions
        )
        chunks = min(len(self._work[0]), n)
        with using_threads(self._threads):
            many(chunks, n, *arguments, *work[:spaces], *more, *work[spaces:])

    def copy(self, source: ArrayLike, target: ArrayLike) -> None:
        """Make environments `target` those that `source` are, in every respect: both (m,) indices.

        What they drive from there on is the same, disturbances included, under the same weights.
        """
        rows, onto = np.asarray(source, dtype=np.intp), np.asarray(target, dtype=np.intp)
        self.envs.copy(rows, onto)
        self.memory.copy(rows, onto)

    def _checked_weights(self, weights: ArrayLike | None) -> tuple[Array, Array]:
        """Tables (1 or n, bands, 10) and the rules by which a band is chosen."""
        if weights is None and self._decider is not None:
            return self.memory.tables, self._rules
        if weights is None:
            return self.agent.switching.tables, self.agent.switching.rules
        values = np.asarray(weights, dtype=np.float64)
        n, count = self.envs.num_envs, len(self.bands)
        if values.ndim < 3:
            values = np.atleast_2d(values)
        if values.shape in {(1, 10), (n, 10)}:
            values = np.repeat(values[:, None], count, axis=1)
        if values.shape not in {(1, count, 10), (n, count, 10)}:
            tables = f" or ({n}, {count}, 10)" if count > 1 else ""
            raise ValueError(f"weights must be (10,) or ({n}, 10){tables}, not {np.shape(weights)}")
        bad = ~(np.isfinite(values) & (values >= 0.0)).all(axis=(1, 2))
        if bad.any():
            row = int(np.argmax(bad))
            raise ValueError(f"weights of environment {row} must be finite and >= 0: {values[row]}")
        # A copy: one compiled form takes it, whatever array it came in.
        return np.array(values, order="C"), self._rules
