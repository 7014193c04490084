"""`WeightTuning-v0`, many at once: vehicles with an NMPC each, whose weights are chosen."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

import agents
from agents.nmpc.closed_loop import ClosedLoop, Tally
from agents.weight_tuning import features
from agents.weight_tuning.choice import WeightChoice, weights_for_all
from agents.weight_tuning.deciding import Decider
from agents.weight_tuning.score import FAILED, failed, parts_of, scores_of
from agents.weight_tuning.watching import CLOCK, FAILURES, ITERATIONS
from lpv_track_env import kernels as k
from lpv_track_env.conditions import Conditions
from lpv_track_env.vector_checks import checked_mask, checked_mode
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vector_infos import NAMES
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

Array = NDArray[Any]
Infos = dict[str, Any]

END_WINDOWS = 10.0
"""Windows of the worst score that the end of a drive that fails costs."""


class WeightTuningVectorEnv(VectorEnv[Array, Array, Array]):
    """`num_envs` vehicles follow paths with `lpv-nmpc`; an action chooses its weights.

    `gymnasium.make_vec("lpv_track_env/WeightTuning-v0", num_envs=n,
    vectorization_mode="vector_entry_point", ...)` makes one. Plant, estimator, delay compensation
    and NMPC run in compiled code; see `WeightTuningEnv` for actions, observations and rewards.
    Environment i of `reset(seed=s)` is a single environment of `reset(seed=s + i)`.

    ## Autoreset

    As in `PathTrackingVectorEnv`: `NEXT_STEP` (default), `SAME_STEP`, `DISABLED`.

    ## Arguments

    Those of `WeightTuningEnv`, and `num_envs`, `autoreset_mode`, `threads`; `trajectory` and
    `vehicle` may be sequences, of which every episode draws one each.
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
        conditions: str | Conditions | dict[str, Any] = "realtime",
        control_period: float = 0.05,
        render_mode: str | None = None,
        *,
        choice: WeightChoice | None = None,
        delay_compensation: bool | None = None,
        preview_steps: int = 20,
        preview_period: float | None = None,
        max_lateral_error: float = 5.0,
        time_limit: float | None = None,
        initial_error_range: tuple[float, float, float] = (0.0, 0.0, 0.0),
        random_start: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
    ) -> None:
        self.choice = WeightChoice() if choice is None else choice
        self.drives = PathTrackingVectorEnv(
            num_envs, trajectory, vehicle, speed_mode, fixed_speed, conditions, control_period,
            render_mode, preview_steps=preview_steps, preview_period=preview_period,
            max_lateral_error=max_lateral_error, time_limit=time_limit,
            initial_error_range=initial_error_range, random_start=random_start,
            autoreset_mode=AutoresetMode.DISABLED, threads=threads,
        )  # fmt: skip
        agent: Any = agents.make(
            "lpv-nmpc", self.drives.single, delay_compensation=delay_compensation
        )
        self._decider = Decider(self.choice, (), control_period)
        self.loop = ClosedLoop(self.drives, agent, decider=self._decider, threads=threads)
        self.num_envs = self.drives.num_envs
        self.render_mode = render_mode
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = observation_space(self.choice)
        self.single_action_space = action_space(self.choice)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        n = self.num_envs
        self._sums = np.zeros((len(Tally._fields), n))
        self._ended = np.zeros(n, dtype=np.bool_)
        self._rejected = np.zeros(n, dtype=np.int64)
        self._clipped = np.zeros(n, dtype=np.int64)

    @property
    def solves(self) -> int:
        """Solves of the episodes since the last reset of each; see `Tally.solves`."""
        return int(self._sums[-1].sum())

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Infos | None = None
    ) -> tuple[Array, Infos]:
        """Begin episodes: of all environments, or of those that `options["reset_mask"]` marks.

        Other options are those of `PathTrackingEnv`, errors those of `PathTrackingVectorEnv`.
        """
        mask = checked_mask((options or {}).get("reset_mask"), self.num_envs)
        seeds: Any = seed
        if isinstance(seed, int):
            super().reset(seed=seed)
        self.loop.reset(seed=seeds, options=options)
        self._begin(mask)
        return self._observe(), self._infos(mask)

    def _begin(self, mask: Array) -> None:
        """Forget the episodes that a mask marks, and see the first observation of the next."""
        self._sums[:, mask] = 0.0
        self._ended[mask] = False
        self._rejected[mask] = self._clipped[mask] = 0
        self.loop.attend(mask)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Drive on with the weights that are chosen, until the window or the band ends."""
        if not self.drives.begun:
            raise gymnasium.error.ResetNeeded("the episodes have not begun: call reset() first")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise gymnasium.error.ResetNeeded(
                f"the episode of environment {int(np.argmax(self._ended))} has ended: call "
                "reset(options={'reset_mask': mask}) before step()"
            )
        self._choose(checked_choices(actions, self.choice, self.num_envs))
        begins = self._ended.copy()
        tally = self.loop.drive(self._decider.window, self.loop.memory.tables, until_band=True)
        ends = self.drives.arrays.ends
        self._ended = ends != k.RUNNING
        self._add(tally)
        ended = self._ended & ~begins
        rewards = self._rewards(tally, ended)
        truncated = ended & (ends == k.TIME_LIMIT)
        terminated = ended & ~truncated
        infos = self._infos(~begins, tally)
        if ended.any():
            infos["end"] = np.where(ended, NAMES[ends], np.array(None))
            infos["score"] = np.where(ended, scores_of(Tally(*self._sums), ends), 0.0)
            infos["_end"] = infos["_score"] = ended
        again = begins
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            infos.update(self._final(ended, infos))
            again = ended
        if self.autoreset_mode is not AutoresetMode.DISABLED and again.any():
            self.loop.reset(options={"reset_mask": again})
            self._begin(again)
        return self._observe(), rewards, terminated, truncated, infos

    def _choose(self, actions: Array) -> None:
        """Write what actions (n, entries) mean into the tables of running vehicles."""
        memory, p = self.loop.memory, self._decider.packed
        running = ~self._ended
        refused = np.zeros(self.num_envs, dtype=np.bool_)
        weights_for_all(
            actions, running, memory.nmpc.bands, p.sets, p.matrix, p.log_span, p.catalogue,
            memory.tables, refused,
        )  # fmt: skip
        self._rejected += refused
        self._clipped += running & (np.abs(actions) > 1.0).any(axis=1) & (p.catalogue.size == 0)
        decided = memory.watched[running]
        decided[:, [CLOCK, FAILURES, ITERATIONS]] = 0.0
        memory.watched[running] = decided

    def _add(self, tally: Tally) -> None:
        """Add a window to the episodes' tallies."""
        values = np.array(tally)
        largest = [Tally._fields.index(name) for name in ("max_lateral", "max_heading")]
        peaks = np.maximum(self._sums[largest], values[largest])
        self._sums += values
        self._sums[largest] = peaks

    def _rewards(self, tally: Tally, ended: Array) -> Array:
        share = tally.steps / self._decider.window
        rewards: Array = -parts_of(tally).sum(axis=1) * share
        rewards[ended & failed(self.drives.arrays.ends)] -= FAILED * END_WINDOWS
        return rewards

    def _observe(self) -> Array:
        """Features of every environment, (n, size) float32."""
        memory, p = self.loop.memory, self._decider.packed
        seen = np.zeros((self.num_envs, self.single_observation_space.shape[0]), dtype=np.float32)  # type: ignore[index]
        features.fill_all(
            self.drives.arrays.observations, memory.watched, memory.nmpc.weights, p.sets,
            memory.nmpc.bands, features.SCALES, p.log_span, seen,
        )  # fmt: skip
        return seen

    def _infos(self, mask: Array, tally: Tally | None = None) -> Infos:
        """Infos of the window that was driven, for the environments that `mask` (n,) marks."""
        memory = self.loop.memory
        parts = np.zeros((self.num_envs, 5)) if tally is None else parts_of(tally)
        zero = np.zeros(self.num_envs)
        infos: Infos = {
            "parts": np.where(mask[:, None], parts, 0.0),
            "steps": (zero if tally is None else tally.steps).astype(np.int64),
            "solves": (zero if tally is None else tally.solves).astype(np.int64),
            "failures": (zero if tally is None else tally.failures).astype(np.int64),
            "band": np.where(mask, memory.nmpc.bands, 0),
            "weights": np.where(mask[:, None], memory.nmpc.weights, 0.0),
            "rejected": np.where(mask, self._rejected, 0),
            "clipped": np.where(mask, self._clipped, 0),
        }
        infos.update({f"_{name}": mask for name in list(infos)})
        return infos

    def _final(self, ended: Array, infos: Infos) -> Infos:
        """`final_obs` and `final_info` of the episodes that have `ended` (n,)."""
        observations, last = self._observe(), np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended).tolist():
            last[i] = observations[i]
        named = [name for name in infos if not name.startswith("_")]
        final = {name: infos[name] for name in named} | {f"_{name}": ended for name in named}
        return {
            "final_obs": last, "_final_obs": ended, "final_info": final, "_final_info": ended,
        }  # fmt: skip

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw every environment, as `PathTrackingVectorEnv` does."""
        return self.drives.render()

    def close_extras(self, **_: Any) -> None:
        """Free what drawing took."""
        self.drives.close()


def observation_space(choice: WeightChoice) -> spaces.Box:
    """Space of the features that a choice is made on."""
    shape = (features.size(len(choice.bands)),)
    return spaces.Box(-features.LIMIT, features.LIMIT, shape, dtype=np.float32)


def action_space(choice: WeightChoice) -> spaces.Box | spaces.Discrete[np.int64]:
    """Space of the actions of a choice."""
    if choice.catalogue:
        return spaces.Discrete(len(choice.catalogue))
    return spaces.Box(-1.0, 1.0, (choice.entries,), dtype=np.float32)


def checked_choices(actions: Any, choice: WeightChoice, num_envs: int) -> Array:
    """Actions as float64 (n, entries); of a catalogue, 1 for the set that is chosen.

    Numbers that are not finite are let through: weights stay as they are then.

    Raises
    ------
    ValueError
        For a wrong shape or type, or an index that is not in the catalogue.
    """
    try:
        given = np.asarray(actions)
    except ValueError:
        given = np.empty(0)
    count = choice.entries
    if not choice.catalogue:
        if given.shape != (num_envs, count) or given.dtype.kind not in "fiu":
            raise ValueError(
                f"actions must be an array {(num_envs, count)} of numbers in [-1, 1], "
                f"{choice.directions!r} log-multipliers, not {given.shape} of {given.dtype}"
            )
        return np.ascontiguousarray(given, dtype=np.float64)
    if given.shape != (num_envs,) or given.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be {num_envs} indices of a catalogue, not {given.shape} of {given.dtype}"
        )
    if not ((given >= 0) & (given < count)).all():
        wrong = given[(given < 0) | (given >= count)][0]
        raise ValueError(f"the catalogue has sets 0 to {count - 1}, not {wrong}")
    chosen: Array = np.eye(count)[given]
    return chosen
