"""`lpv_track_env/WeightTuning-v0`: an NMPC drives, the action chooses its weights."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.vector_env import NOT_TAKEN, WeightTuningVectorEnv
from lpv_track_env.env import RESET_OPTIONS, PathTrackingEnv
from lpv_track_env.validation import forwards_arguments
from trajectories.naming import choose

Array = NDArray[Any]


class WeightTuningEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """A vehicle follows a reference path with `lpv-nmpc`; an action chooses the NMPC's Q and S.

    One step drives a window of control periods (0.4 s), or up to where the preview enters another
    band of curvature, with the weights that the action chooses for the band at hand.

    ## Action space

    Box in [-1, 1], float32: logarithms of what the base's Q and S of this band are multiplied by,
    in units of ln(span); an entry each for speed, heading and position ("joint"), for these in Q
    and then in S ("stages"), or for each of Q and S on [vx, psi, X, Y] ("all"). With a catalogue,
    Discrete: which of its sets is taken. R stays: only ratios matter.

    Weights move at the base's slew limit, within the bounds of `TrackingWeights`; the NMPC keeps
    its warm start. Entries beyond [-1, 1] are clipped; an action with one that is not finite is
    rejected, and the band keeps the set that was last chosen for it, at first the base's. Both are
    counted in infos and the drive goes on. A wrong shape or type, or an index that is not in the
    catalogue, is a ValueError and leaves the episode untouched.

    ## Observation space

    Box of features, float32: `agents.weight_tuning.features` names every entry and its scale. They
    are made of what the agent itself sees and does: errors, preview, band, weights in use, solver,
    and mean squares of errors, surprises and lags over 0.4 s and 4 s. The truth is not among them.

    ## Reward

    Minus what the window adds to its drive's score, to first order (`marginal_parts` of
    `agents.weight_tuning.score`), times its share of a whole window; of the truth. A drive that
    fails ends with minus 250 besides: ten windows of the worst. A window of a good drive costs 1 to
    3 under "realtime", so that is dearer than to drive on for discount factors up to 0.99, and not
    for those close to 1 on a long path.

    ## Episode

    As in `PathTrackingEnv`: terminated at the path's end, off the road or turned around; truncated
    at the time limit. Where a computer misses its deadlines a window may end while it is busy: what
    is chosen then holds from its next solve on.

    ## Infos

    `parts` (5,) of the window; `steps`, `solves`, `failures` of the window; `band` that the next
    action is for; `weights` (10,) in use, zeros before the first window; how many actions of the
    episode were `rejected` and `clipped`; at its end `end` and its `score`.

    ## Arguments

    Those of `PathTrackingEnv` but its reward's weights, and

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
        """Drive a window with the weights that are chosen; see the class."""
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
        """Free what drawing took."""
        self.drives.close()


def _single(infos: dict[str, Any]) -> dict[str, Any]:
    """Infos of a vector environment of one, as a single environment's."""
    single = {}
    for name, values in infos.items():
        if name.startswith("_"):
            continue
        value = values[0]
        single[name] = value.item() if isinstance(value, np.generic) else value
    return single
