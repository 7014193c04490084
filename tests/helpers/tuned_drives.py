"""Drives whose weights are chosen window by window, in Python: `predict`, then `step`, in turns."""

import copy
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

import agents
from agents.nmpc.rti_agent import RtiNmpc
from agents.weight_tuning.choice import WeightChoice
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from lpv_track_env.env import PathTrackingEnv
from trajectories import CurvatureBands

Array = NDArray[Any]

# Episodes of some four windows, with most ways to end.
LIVELY: dict[str, Any] = {
    "trajectory": "figure-eight",
    "initial_error_range": (0.6, 0.2, 2.0),
    "random_start": True,
    "max_lateral_error": 0.65,
    "time_limit": 1.8,
}
# None of these ends within the tests.
CALM: dict[str, Any] = {**LIVELY, "max_lateral_error": 5.0, "time_limit": 60.0}

CATALOGUE = (
    TrackingWeights(),
    TrackingWeights(Q=(1.0, 1.0, 1.0, 1.0), R=(0.1, 30.0)),
    TrackingWeights(Q=(5.0, 20.0, 3.0, 3.0), S=(1.0, 2.0, 3.0, 4.0)),
)
SCHEDULE = WeightSchedule(
    CurvatureBands((0.01, 0.04), ("low", "middle", "high")),
    (TrackingWeights(), TrackingWeights(R=(0.1, 10.0)), TrackingWeights(Q=(2.0, 3.0, 4.0, 5.0))),
    slew=3.0,
)
CHOICES: dict[str, WeightChoice] = {
    "joint": WeightChoice(),
    "stages": WeightChoice(directions="stages", span=3.0, window=0.25),
    "all": WeightChoice(directions="all"),
    "schedule": WeightChoice(SCHEDULE),
    "catalogue": WeightChoice(catalogue=CATALOGUE),
}


def random_actions(choice: WeightChoice, count: int, *shape: int, seed: int = 0) -> Array:
    """Actions (count, *shape, entries), or indices of the catalogue; some Box entries beyond 1."""
    rng = np.random.default_rng(seed)
    if choice.catalogue:
        return rng.integers(choice.entries, size=(count, *shape))
    return rng.uniform(-1.2, 1.2, (count, *shape, choice.entries)).astype(np.float32)


# What the action multiplies, on Q's and S's [vx, psi, X, Y], written out once more.
JOINT = [[0, 4], [1, 5], [2, 3, 6, 7]]
STAGES = [[0], [1], [2, 3], [4], [5], [6, 7]]
GROUPS = {"joint": JOINT, "stages": STAGES, "all": [[j] for j in range(8)]}


def meant(choice: WeightChoice, action: Any, band: int) -> Array:
    """Set (12,) that an action asks for in a band."""
    if choice.catalogue:
        return choice.catalogue[int(action)].as_array()
    wanted = choice.schedule.weights[band].as_array()
    for group, entry in zip(GROUPS[choice.directions], np.clip(action, -1.0, 1.0), strict=True):
        wanted[group] *= math.exp(math.log(choice.span) * float(entry))
    return np.clip(wanted, LOWEST, HIGHEST)


SCALE = np.array([0.05, 0.1, 0.5, 0.2, 4.0])


class ByHand:
    """What `WeightTuningEnv` is to do: a `PathTrackingEnv` and its agent, weights set each period.

    `observations` (steps + 1, size) and `actions` (steps, 2) of the episode are kept, and
    `truths`, its infos with the actuators.
    """

    def __init__(self, choice: WeightChoice, *, delayed: bool | None = None, **settings: Any):
        self.choice = choice
        self.env = PathTrackingEnv(**{"conditions": "realtime", **settings})
        self.agent: Any = agents.make("lpv-nmpc", self.env, delay_compensation=delayed)
        self.horizon = self.env.layout.preview_steps

    def reset(self, **given: Any) -> None:
        self.agent.reset()
        observation, _ = self.env.reset(**given)
        self.table = np.array([one.as_array() for one in self.choice.schedule.weights])
        self.used: Array | None = None
        self.band: int | None = None
        self.observations, self.actions = [observation], []
        self.truths: list[dict[str, Any]] = []
        self.iterations: list[int] = []
        self.actuators = [self.env.actuators]
        self.done = False
        self.band = self.next_band()

    @property
    def nmpc(self) -> RtiNmpc:
        inner = getattr(self.agent, "agent", self.agent)
        assert isinstance(inner, RtiNmpc)
        return inner

    def next_band(self) -> int:
        """Band of what the NMPC will be shown, by the bands' own `select`."""
        seen = np.array(self.observations[-1][None], dtype=np.float64)
        future = getattr(self.agent, "future", None)
        if future is not None:
            memory = copy.deepcopy(self.agent._memory)
            starts = np.array([memory is None])
            future.predict(seen, starts, future.memory(1) if memory is None else memory)
        preview = self.env.layout.unpack(seen[0]).preview_curvature[: self.horizon]
        return self.choice.bands.select(preview, self.band)

    def step(self, action: Any) -> int:
        """Drive a window; how many periods it had."""
        assert self.band is not None
        if np.isfinite(action).all():
            self.table[self.band] = meant(self.choice, action, self.band)
        most = max(round(self.choice.window / self.env.control_period), 1)
        band, first = self.band, len(self.actions)
        while len(self.actions) - first < most:
            if self.env.controller_busy:
                self.agent.hold()
                command = self.actions[-1]
            else:
                command = self.solve(self.table[band])
            observation, _, terminated, truncated, info = self.env.step(command)
            self.observations.append(observation)
            self.actions.append(command)
            self.truths.append(info)
            self.actuators.append(self.env.actuators)
            self.done = terminated or truncated
            # A busy computer sees nothing, but for who decides at the window's end.
            if self.done or not self.env.controller_busy or len(self.actions) - first == most:
                self.band = self.next_band()
            if self.done or self.band != band:
                break
        return len(self.actions) - first

    def solve(self, target: Array) -> Array:
        """Command under weights that have moved towards a target."""
        if self.used is not None:
            factor = math.exp(self.choice.slew * self.env.control_period)
            target = np.minimum(np.maximum(target, self.used / factor), self.used * factor)
        self.used = target.copy()
        assert self.agent.set_weights(target)
        command, memory = self.agent.predict(self.observations[-1])
        self.iterations.append(self.agent.diagnostics(memory[0])["iterations"])
        return np.asarray(command)

    def parts(self, first: int, last: int) -> Array:
        """The score's parts over periods first to last - 1, by its definition."""
        return np.asarray(np.sqrt(self.squares(first, last).mean(axis=0)) / SCALE)

    def marginal(self, first: int, last: int, periods: int = 8) -> Array:
        """What these periods add to the parts of the drive from its beginning, to first order."""
        usual = 5 * periods * np.array([0.05, 0.03, 0.1, 0.08, 0.8]) ** 2
        drive = self.squares(0, last)
        rho = np.sqrt((usual + drive.sum(axis=0)) / (5 * periods + len(drive)))
        mean = self.squares(first, last).mean(axis=0)
        return np.asarray((mean / rho + rho) / 2.0 / SCALE)

    def squares(self, first: int, last: int) -> Array:
        """Squares of errors and rates over periods first to last - 1, (n, 5)."""
        told = self.truths[first:last]
        errors = np.array(
            [[t[f"{name}_error"] for name in ("lateral", "heading", "speed")] for t in told]
        )
        rates = np.diff(np.array(self.actuators[first : last + 1]), axis=0)[:, ::-1]
        values = np.hstack([errors, rates / self.env.control_period])
        return np.asarray(values**2)
