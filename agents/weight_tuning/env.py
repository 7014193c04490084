"""`lpv_track_env/WeightTuning-v0`: an NMPC drives, and actions choose its weights."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

import agents
from agents.weight_tuning.choice import (
    WeightChoice,
    action_space,
    checked_actions,
    observation_space,
)
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from agents.weight_tuning.decision import Decider
from agents.weight_tuning.score import FAILED, failed, marginal_parts, parts_of, scores_of
from agents.weights import in_words
from lpv_track_env import kernels as k
from lpv_track_env.env import RESET_OPTIONS, PathTrackingEnv
from lpv_track_env.episodes import ENDS
from lpv_track_env.validation import checked_mask, checked_mode, forwards_arguments
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories.arguments import instance_of
from trajectories.naming import choose

Array = NDArray[Any]
Infos = dict[str, Any]

NOT_TAKEN = ("reward_weights", "plant", "render_colour")
"""Arguments of `PathTrackingEnv` that the weight-tuning environments do not take."""
END_WINDOWS = 10.0
"""Cost of a failed drive, in windows of the worst score."""


class WeightTuningEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """A vehicle follows a reference path with `lpv-nmpc`; an action chooses the NMPC's Q and S.

    One step drives a window of control periods (0.4 s), or until the preview enters another band of
    curvature, with the weights that the action chooses for the present band.

    ## Action space

    Box in [-1, 1], float32: logarithms of the factors on the base's Q and S of this band, in units
    of ln(span); one entry each for speed, heading and position ("joint"), for these in Q and then
    in S ("stages"), or for each of Q and S on [vx, psi, X, Y] ("all"). With a catalogue, Discrete:
    the index of one of its sets. R stays as it is: only ratios matter.

    Weights move at the base's slew limit, within the bounds of `TrackingWeights`; the NMPC keeps
    its warm start. Entries beyond [-1, 1] are clipped. An action with an entry that is not finite
    is rejected: the band keeps the set last chosen for it, at first the base's. Infos count both,
    and the drive goes on. A wrong shape or type, or an index that is not in the catalogue, raises a
    ValueError and leaves the episode unchanged.

    ## Observation space

    Box of features, float32: `agents.weight_tuning.features` describes every entry and its scale.
    They use what the agent itself observes and does, never the true state: errors, preview, band,
    weights in use, solver, and mean squares of errors, surprises and lags over 0.4 s and 4 s.

    ## Reward

    Minus the window's contribution to the score of its drive, to first order (`marginal_parts` of
    `agents.weight_tuning.score`, from true errors), times its share of a whole window. A failed
    drive ends with a further -250: ten windows of the worst score. A window of a good drive costs 1
    to 3 under "realtime", so failing is worse than driving on for discount factors up to 0.99, but
    not for those close to 1 on a long path.

    ## Episode

    As in `PathTrackingEnv`: terminated at the path's end, off the road or turned around; truncated
    at the time limit. If the computer misses its deadlines, a window may end while it is busy: the
    weights chosen then apply from its next solve on.

    ## Infos

    `parts` (5,) of the window's score; its `steps`, `solves` and `failures`; the `band` of the next
    action; `weights` (12,) in use, zeros before the first window; the numbers of `rejected` and
    `clipped` actions in the episode; its `end` ("" until then) and `score` (0 until then).

    ## Arguments

    Those of `PathTrackingEnv` except its reward's weights, and

    choice
        `agents.weight_tuning.choice.WeightChoice`: base, bands, directions, span or catalogue,
        window.
    conditions
        "realtime" by default: where weights matter.
    delay_compensation
        As in `agents.make`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    @forwards_arguments(PathTrackingEnv, *NOT_TAKEN, conditions="realtime")
    def __init__(
        self,
        settings: dict[str, Any],
        *,
        choice: WeightChoice | None = None,
        delay_compensation: bool | None = None,
    ) -> None:
        self.drives = WeightTuningVectorEnv(
            1, choice=choice, delay_compensation=delay_compensation,
            autoreset_mode=AutoresetMode.DISABLED, **settings,
        )  # fmt: skip
        self.choice, self.render_mode = self.drives.choice, self.drives.render_mode
        self.observation_space = self.drives.single_observation_space
        self.action_space = self.drives.single_action_space
        self.metadata = {**self.metadata, "render_fps": self.drives.metadata["render_fps"]}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; options are those of `PathTrackingEnv`."""
        for key in options or {}:
            choose("reset option", key, RESET_OPTIONS)
        observations, infos = self.drives.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return observations[0], _single(infos)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive a window with the chosen weights; see the class."""
        if not self.drives.loop.running[0]:
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset() before step()")
        actions: Any = [action]
        observations, rewards, terminated, truncated, infos = self.drives.step(actions)
        return (
            observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]),
            _single(infos),
        )  # fmt: skip

    def render(self) -> Any:
        """Draw the vehicle on its path: (600, 900, 3) uint8."""
        frames = self.drives.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Close the renderer."""
        self.drives.close()


def _single(infos: dict[str, Any]) -> dict[str, Any]:
    """Convert the infos of a vector environment of size 1 to those of a single environment."""
    single = {}
    for name, values in infos.items():
        if name.startswith("_"):
            continue
        value = values[0]
        single[name] = value.item() if isinstance(value, np.generic) else value
    return single


class WeightTuningVectorEnv(VectorEnv[Array, Array, Array]):
    """`num_envs` vehicles follow paths with `lpv-nmpc`; actions choose its weights.

    `gymnasium.make_vec("lpv_track_env/WeightTuning-v0", num_envs=n,
    vectorization_mode="vector_entry_point", ...)` makes one. Plant, estimator, delay compensation
    and NMPC run in compiled code; see `WeightTuningEnv` for actions, observations and rewards.
    After `reset(seed=s)` environment i equals a single environment after `reset(seed=s + i)`.

    ## Autoreset, infos

    As in `PathTrackingVectorEnv`: modes `NEXT_STEP` (default), `SAME_STEP` and `DISABLED`, with
    infos in the form of Gymnasium's `SyncVectorEnv`.

    ## Arguments

    Those of `WeightTuningEnv`, and `num_envs`, `autoreset_mode`, `threads`; `trajectory` and
    `vehicle` may be sequences, from which every episode draws one. The model of every NMPC is the
    first vehicle, whichever it drives.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  declared so by gymnasium
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    @forwards_arguments(PathTrackingEnv, *NOT_TAKEN, conditions="realtime")
    def __init__(
        self,
        settings: dict[str, Any],
        num_envs: int = 1,
        *,
        choice: WeightChoice | None = None,
        delay_compensation: bool | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
    ) -> None:
        choice = WeightChoice() if choice is None else choice
        self.choice: WeightChoice = instance_of("choice", choice, WeightChoice, "WeightChoice")
        self.drives = PathTrackingVectorEnv(
            num_envs, autoreset_mode=AutoresetMode.DISABLED, threads=threads, **settings
        )
        agent: Any = agents.make(
            "lpv-nmpc", self.drives.single, delay_compensation=delay_compensation
        )
        self._decider = Decider(self.choice, (), self.drives.single.control_period)
        self.loop = ClosedLoop(self.drives, agent, decider=self._decider, threads=threads)
        self.num_envs = self.drives.num_envs
        self.render_mode = self.drives.render_mode
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {
            **self.metadata, "autoreset_mode": self.autoreset_mode,
            "render_fps": max(round(1.0 / self.choice.window), 1),
        }  # fmt: skip
        self.single_observation_space = observation_space(self.choice)
        self.single_action_space = action_space(self.choice)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        n = self.num_envs
        self._sums = np.zeros((len(Tally._fields), n))
        self.solves = 0
        """Solves of all environments since they were made: the budget of tuning."""
        self._ended = np.zeros(n, dtype=np.bool_)
        self._rejected = np.zeros(n, dtype=np.int64)
        self._clipped = np.zeros(n, dtype=np.int64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Infos | None = None
    ) -> tuple[Array, Infos]:
        """Begin episodes in all environments, or in those that `options["reset_mask"]` marks.

        Other options are those of `PathTrackingEnv`, errors those of `PathTrackingVectorEnv`.
        """
        mask = checked_mask((options or {}).get("reset_mask"), self.num_envs)
        seeds: Any = seed
        self.loop.reset(seed=seeds, options={**(options or {}), "reset_mask": mask})
        # All arguments have been checked: the previous episodes end here.
        if isinstance(seed, int):
            super().reset(seed=seed)
        self._begin(mask)
        return self._observe(), self._infos(mask)

    def _begin(self, mask: Array) -> None:
        """Clear the episodes that a mask marks, and take in the first observations of the next."""
        self._sums[:, mask] = 0.0
        self._ended[mask] = False
        self._rejected[mask] = self._clipped[mask] = 0
        self.loop.take_in(mask)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Drive on with the chosen weights, until the window or the band ends."""
        self._check_order()
        self._choose(checked_actions(actions, self.choice, self.num_envs))
        begins = self._ended
        tally = self.loop.drive(self._decider.window, self.loop.memory.tables, until_band=True)
        ends = self.drives.arrays.ends
        self._ended = ends != k.RUNNING
        ended = self._ended & ~begins
        # The last observation of an episode has the same features as if the episode went on.
        self.loop.take_in(ended)
        self._add(tally)
        rewards = self._rewards(tally, ended)
        truncated = ended & (ends == k.TIME_LIMIT)
        infos: Infos = {}
        again, reported = begins, ended
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            infos = self._final(ended, tally)
            again, reported = ended, np.zeros_like(ended)
            tally = Tally(*(np.array(tally) * ~again))
        if self.autoreset_mode is not AutoresetMode.DISABLED and again.any():
            self.loop.reset(options={"reset_mask": again})
            self._begin(again)
        infos.update(self._infos(np.ones_like(ended), tally, reported))
        return self._observe(), rewards, ended & ~truncated, truncated, infos

    def _check_order(self) -> None:
        if not self.drives.begun:
            raise gymnasium.error.ResetNeeded("the episodes have not begun: call reset() first")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise gymnasium.error.ResetNeeded(
                f"the episode of environment {int(np.argmax(self._ended))} has ended: call "
                "reset(options={'reset_mask': mask}) before step()"
            )

    def _choose(self, actions: Array) -> None:
        """Write the weights that actions (n, entries) choose to the tables of running vehicles."""
        memory, running = self.loop.memory, ~self._ended
        rejected = self._decider.choose(actions, running, memory.nmpc.bands, memory)
        self._rejected += rejected
        beyond = (np.abs(actions) > 1.0).any(axis=1)
        self._clipped += running & beyond & ~rejected

    def _add(self, tally: Tally) -> None:
        """Add a window to the episodes' tallies."""
        values = np.array(tally)
        largest = [Tally._fields.index(name) for name in ("max_lateral", "max_heading")]
        peaks = np.maximum(self._sums[largest], values[largest])
        self._sums += values
        self._sums[largest] = peaks
        self.solves += int(tally.solves.sum())

    def _rewards(self, tally: Tally, ended: Array) -> Array:
        share = tally.steps / self._decider.window
        parts = marginal_parts(tally, Tally(*self._sums), self._decider.window)
        rewards: Array = 0.0 - parts.sum(axis=1) * share
        rewards[ended & failed(self.drives.arrays.ends)] -= FAILED * END_WINDOWS
        return rewards

    def _observe(self) -> Array:
        """Features of every environment, (n, size) float32."""
        return self._decider.observe(self.drives.arrays.observations, self.loop.memory)

    def _infos(self, mask: Array, tally: Tally | None = None, ended: Array | None = None) -> Infos:
        """Return a window's infos for the environments that `mask` (n,) marks, else zeros.

        `ended` (n,) marks those whose episode this window ended.
        """
        ended = np.zeros_like(mask) if ended is None else ended
        ends = np.where(ended, self.drives.arrays.ends, k.RUNNING)
        memory = self.loop.memory
        driven = Tally(*np.zeros_like(self._sums)) if tally is None else tally
        infos: Infos = {
            "parts": np.where(mask[:, None], parts_of(driven), 0.0),
            "steps": np.where(mask, driven.steps, 0.0).astype(np.int64),
            "solves": np.where(mask, driven.solves, 0.0).astype(np.int64),
            "failures": np.where(mask, driven.failures, 0.0).astype(np.int64),
            "band": np.where(mask, memory.nmpc.bands, 0),
            "weights": np.where(mask[:, None], memory.nmpc.weights, 0.0),
            "rejected": np.where(mask, self._rejected, 0),
            "clipped": np.where(mask, self._clipped, 0),
            "end": np.where(mask, ENDS[ends], np.array(None)),
            "score": np.zeros(self.num_envs),
        }
        if ended.any():
            infos["score"][ended] = scores_of(Tally(*self._sums), ends)[ended]
        infos.update({f"_{name}": mask for name in list(infos)})
        return infos

    def _final(self, ended: Array, tally: Tally) -> Infos:
        """Return `final_obs` and `final_info` of the episodes that have `ended` (n,)."""
        observations, last = self._observe(), np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended).tolist():
            last[i] = observations[i]
        return {
            "final_obs": last, "_final_obs": ended,
            "final_info": self._infos(ended, tally, ended), "_final_info": ended,
        }  # fmt: skip

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw every environment, as `PathTrackingVectorEnv` does, and the weights in use."""
        # The weights are zeros before the first window of an episode.
        return self.drives.render(
            [in_words(row) if row.any() else {} for row in self.loop.memory.nmpc.weights]
        )

    def close_extras(self, **_: Any) -> None:
        """Close the renderers."""
        self.drives.close()
