"""Vector environment of `WeightTuning-v0`: many vehicles, each with an NMPC."""

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
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.episodes import END_NAMES
from lpv_track_env.validation import checked_mask, checked_mode, forwards_arguments
from lpv_track_env.vector_env import PathTrackingVectorEnv

Array = NDArray[Any]
Infos = dict[str, Any]

NOT_TAKEN = ("reward_weights", "plant", "render_colour")
"""Arguments of `PathTrackingEnv` that the weight-tuning environments do not take."""
END_WINDOWS = 10.0
"""Cost of a failed drive, in windows of the worst score."""


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
        self.choice = WeightChoice() if choice is None else choice
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
        self._solves = 0
        self._ended = np.zeros(n, dtype=np.bool_)
        self._rejected = np.zeros(n, dtype=np.int64)
        self._clipped = np.zeros(n, dtype=np.int64)

    @property
    def solves(self) -> int:
        """Solves of all environments since they were made: the budget of tuning."""
        return self._solves

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
        self._solves += int(tally.solves.sum())

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

        Environments that `ended` (n,) marks have an `end` and a `score`, too.
        """
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
        }
        infos.update({f"_{name}": mask for name in list(infos)})
        if ended is not None and ended.any():
            ends = self.drives.arrays.ends
            infos["end"] = np.where(ended, END_NAMES[ends], np.array(None))
            infos["score"] = np.where(ended, scores_of(Tally(*self._sums), ends), 0.0)
            infos["_end"] = infos["_score"] = ended
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
