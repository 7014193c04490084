"""`lpv_track_env/WeightTuning-v0`: an NMPC drives, and the action chooses its weights."""

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
    action; `weights` (10,) in use, zeros before the first window; the numbers of `rejected` and
    `clipped` actions in the episode; and where it ended, its `end` and `score`.

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
