"""`lpv_track_env/PathTracking-v0`: drive a reference path with acceleration and steering."""

import math
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lpv_track_env import kernels, vehicle
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.reward import RewardWeights
from lpv_track_env.task import CONDITIONS, Task, checked_period, choose, reference
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath

if TYPE_CHECKING:
    from lpv_track_env.rendering import Renderer

RESET_OPTIONS = (
    "trajectory",
    "vehicle",
    "arc_length",
    "lateral_error",
    "heading_error",
    "speed_error",
)
NUMBERS = (float, int)


class PathTrackingEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A vehicle (dynamic bicycle) follows a reference path.

    ## Action space

    `Box(float32, (2,))`, SI units, the command held over one control period:

    | entry | meaning | low | high |
    |---|---|---|---|
    | 0 | acceleration command a, m/s^2 | -5 | 3.5 |
    | 1 | front steering angle delta, rad, left positive | -pi/6 | pi/6 |

    The actuators clip range (the bounds above, of the vehicle) and rate (0.5236 rad/s, 5 m/s^3):
    `info["clipped"]` holds bits 1 (acceleration range), 2 (its rate), 4 (steering range), 8 (its
    rate). An action that is not finite, or of the wrong shape or type, is a ValueError and leaves
    the episode untouched.

    ## Observation space

    `Box(float32, (8 + 2 K,))`: body velocities, yaw rate, actuators, errors and a preview of the
    reference's curvature and speed over K periods. Every entry, its unit and sign:
    `lpv_track_env.observation`. Values beyond a bound saturate.

    ## Reward

    Sum of the named terms in `info["reward_terms"]`: progress, lateral, heading, speed, input_rate,
    end; formulas and default weights in `lpv_track_env.reward`. Perfect tracking gives 1 a second.

    ## Episode end

    `terminated`, with `info["end"]`:

    | end | when |
    |---|---|
    | `finished` | the foot point reaches the end of the path (a closed path: after one lap) |
    | `left_corridor` | lateral error over `max_lateral_error` |
    | `wrong_heading` | heading error over 90 degrees |
    | `non_finite` | the state is no longer finite (the last finite one is kept) |

    `truncated`, with `info["end"] = "time_limit"`, by the time limit alone.

    ## Starting state

    On the path at its start, at the reference speed, steering straight. `initial_error_range` draws
    uniform errors in lateral offset (m), heading (rad) and speed (m/s); `random_start` draws the
    arc length too. All randomness comes from `self.np_random`.

    `reset(options=...)` takes `trajectory`, `vehicle` (both as in the arguments), `arc_length` (m),
    `lateral_error` (m), `heading_error` (rad), `speed_error` (m/s); these hold for the episode
    that begins, and the next reset returns to the constructor's.

    ## Info

    `lateral_error, heading_error, speed_error, arc_length, state` (truth, (6,): vx, vy, psi, r, X,
    Y), `reward_terms, clipped`, and at the end `end`.

    ## Arguments

    trajectory
        A name (`trajectories.names()`), a file, or a `ReferencePath`.
    vehicle
        A preset's name (`lpv_track_env.vehicle.VEHICLES`), a .json file or `VehicleParameters`.
    speed_mode, fixed_speed
        "variable": the path's own speed profile. "fixed": one constant speed in m/s, by default the
        highest that the path's limits allow everywhere.
    conditions
        "simulation": perfect actuators and sensors.
    control_period
        s; the dynamics are integrated with fixed Runge-Kutta steps of at most 5 ms within it.
    preview_steps, preview_period
        K and the spacing of the preview, s (by default the control period).
    reward_weights
        `lpv_track_env.reward.RewardWeights`.
    max_lateral_error
        Half width of the corridor, m.
    time_limit
        s; by default one and a half times the path's duration plus 10 s.

    ## Version history

    v0: first version.
    """

    # `render_fps` is one frame a control period: an instance has its own.
    metadata: dict[str, Any] = {  # noqa: RUF012  declared so by gymnasium.Env
        "render_modes": ["human", "rgb_array"],
        "render_fps": 20,
    }

    def __init__(
        self,
        trajectory: str | Path | ReferencePath = "T1",
        vehicle: str | Path | VehicleParameters = "m2-minibus",
        speed_mode: str = "variable",
        fixed_speed: float | None = None,
        conditions: str = "simulation",
        control_period: float = 0.05,
        render_mode: str | None = None,
        *,
        preview_steps: int = 20,
        preview_period: float | None = None,
        reward_weights: RewardWeights | None = None,
        max_lateral_error: float = 5.0,
        time_limit: float | None = None,
        initial_error_range: tuple[float, float, float] = (0.0, 0.0, 0.0),
        random_start: bool = False,
    ) -> None:
        if render_mode is not None:
            choose("render_mode", render_mode, tuple(self.metadata["render_modes"]))
        self.conditions = choose("conditions", conditions, CONDITIONS)
        self.render_mode = render_mode
        self._speed = (speed_mode, fixed_speed)
        self._initial_error_range = tuple(float(value) for value in initial_error_range)
        if len(self._initial_error_range) != 3 or not all(
            0.0 <= half < math.inf for half in self._initial_error_range
        ):
            raise ValueError("initial_error_range must be three numbers >= 0: m, rad, m/s")
        self._random_start = random_start
        car = _load_vehicle(vehicle)
        period = checked_period(control_period)
        self.base_task = Task(
            path=reference(trajectory, car, speed_mode, fixed_speed),
            vehicle=car,
            control_period=period,
            layout=ObservationLayout(
                preview_steps, period if preview_period is None else float(preview_period)
            ),
            reward_weights=reward_weights or RewardWeights(),
            max_lateral_error=float(max_lateral_error),
            time_limit=time_limit,
        )
        fps = max(round(1.0 / self.base_task.control_period), 1)
        self.metadata = {**self.metadata, "render_fps": fps}
        self._bound = self.base_task.layout.bound
        self.observation_space = spaces.Box(-self._bound, self._bound, dtype=np.float32)
        low, high = car.acceleration_range
        limit = car.max_steering_angle
        self.action_space = spaces.Box(
            np.array([low, -limit], dtype=np.float32), np.array([high, limit], dtype=np.float32)
        )
        self._observation = np.zeros(self.base_task.layout.size, dtype=np.float32)
        self._memory = np.zeros(kernels.MEMORY_SIZE)
        self._action = np.zeros(2)
        self._running = False
        self._renderer: Renderer | None = None
        self._open_views()
        self._use(self.base_task)

    def _open_views(self) -> None:
        """Parts of the arrays that every step needs: to make a view costs as much as a copy."""
        self._state = self._memory[:6]
        self._judged = self._memory[kernels.ARC_LENGTH :]
        # Python numbers pass through a memoryview in half the time.
        self._command: Any = self._action.data

    def _use(self, task: Task) -> None:
        self.task = task
        self._constants = task.constants()
        self._table = task.path.table
        self._arguments = (
            self._memory, self._action, self._constants, self._table, self._bound,
            self._observation,
        )  # fmt: skip

    @property
    def path(self) -> ReferencePath:
        """The reference path of the current episode."""
        return self.task.path

    @property
    def vehicle(self) -> VehicleParameters:
        """The vehicle of the current episode."""
        return self.task.vehicle

    @property
    def control_period(self) -> float:
        """Control period, s."""
        return self.task.control_period

    @property
    def layout(self) -> ObservationLayout:
        """Layout of the observation vector."""
        return self.task.layout

    @property
    def state(self) -> NDArray[np.float64]:
        """True state [vx, vy, psi, r, X, Y], (6,), a copy."""
        return self._state.copy()

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; see the class for `options`."""
        super().reset(seed=seed)
        options = dict(options or {})
        for key in options:
            choose("reset option", key, RESET_OPTIONS)
        task = self._episode_task(options)
        length = task.path.length
        if self._random_start:
            share = 1.0 if task.path.closed else 0.8
            arc_length = float(self.np_random.uniform(0.0, share * length))
        else:
            arc_length = 0.0
        errors = [
            float(self.np_random.uniform(-half, half)) if half > 0 else 0.0
            for half in self._initial_error_range
        ]
        arc_length = _number(options, "arc_length", arc_length)
        if not 0.0 <= arc_length <= length:
            raise ValueError(f"option arc_length must be in [0, {length:.2f}] m, not {arc_length}")
        for k, key in enumerate(("lateral_error", "heading_error", "speed_error")):
            errors[k] = _number(options, key, errors[k])
        # All is checked: from here on the last episode is gone.
        self._use(task)
        self._memory[:] = task.initial_memory(arc_length, (errors[0], errors[1], errors[2]))
        kernels.start(self._memory, self._constants, self._table, self._bound, self._observation)
        self._running = True
        if self._renderer is not None:
            self._renderer.begin(task)
        if self.render_mode == "human":
            self.render()
        return self._observation.copy(), self._outcome()[1]

    def _episode_task(self, options: Mapping[str, Any]) -> Task:
        if not {"trajectory", "vehicle"} & set(options):
            return self.base_task
        car = _load_vehicle(options.get("vehicle", self.base_task.vehicle))
        path = self.base_task.path
        if "trajectory" in options:
            path = reference(options["trajectory"], car, *self._speed)
        return replace(self.base_task, path=path, vehicle=car)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive one control period; see the class for actions, rewards, ends and errors."""
        if not self._running:
            raise gymnasium.error.ResetNeeded(
                "the episode has not begun or has ended: call reset() before step()"
            )
        # What a step costs beside its kernel is spent here: few operations for the usual action, a
        # closer look at all else. An action that is refused leaves the episode untouched.
        values = action.tolist() if type(action) is np.ndarray else action
        if type(values) is list and len(values) == 2:
            a, delta = values
        else:
            a, delta = _two_numbers(action)
        if type(a) is not float or type(delta) is not float:
            a, delta = _two_numbers(action)
        if not (isfinite(a) and isfinite(delta)):
            entry = "1 (steering angle)" if isfinite(a) else "0 (acceleration)"
            raise ValueError(f"action entry {entry} is not finite: {action!r}")
        command = self._command
        command[0] = a
        command[1] = delta
        end = kernels.step(*self._arguments)
        reward, info = self._outcome()
        terminated = truncated = False
        if end:
            info["end"] = kernels.END_NAMES[end]
            truncated = end == kernels.TIME_LIMIT
            terminated = not truncated
            self._running = False
        if self._renderer is not None:
            self._renderer.follow(self._memory)
        if self.render_mode == "human":
            self.render()
        return self._observation.copy(), reward, terminated, truncated, info

    def _outcome(self) -> tuple[float, dict[str, Any]]:
        """Reward of the last step and the info of the present situation."""
        # In the order of the indices in `kernels`, taken apart at once: to look them up one by one
        # takes several times as long.
        (
            arc_length, _, _, lateral_error, heading_error, speed_error, _, clipped, _, reward,
            progress, lateral, heading, speed, input_rate, end,
        ) = self._judged.tolist()  # fmt: skip
        return reward, {
            "lateral_error": lateral_error,
            "heading_error": heading_error,
            "speed_error": speed_error,
            "arc_length": arc_length,
            "state": self._state.copy(),
            "reward_terms": {
                "progress": progress,
                "lateral": lateral,
                "heading": heading,
                "speed": speed,
                "input_rate": input_rate,
                "end": end,
            },
            "clipped": int(clipped) if clipped else 0,
        }

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene: a frame (600, 900, 3) uint8 for "rgb_array", a window for "human"."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='human' or 'rgb_array'")
            return None
        return self._open_renderer(self.render_mode).draw(self._memory)

    def _open_renderer(self, render_mode: str) -> "Renderer":
        if self._renderer is None:
            from lpv_track_env.rendering import Renderer

            self._renderer = Renderer(render_mode, self.metadata["render_fps"])
            self._renderer.begin(self.task)
        return self._renderer

    def show_plan(self, plan: NDArray[np.float64] | None) -> None:
        """Give the renderer an agent's predicted positions, (n, 2) m, to draw in the next frame."""
        if self.render_mode is not None:
            self._open_renderer(self.render_mode).plan = plan

    def close(self) -> None:
        """Close the window, if any."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        # Copied on their own, the views would no longer look at the arrays.
        views = {"_state", "_judged", "_command"}
        kept = {name: value for name, value in self.__dict__.items() if name not in views}
        return {**kept, "_renderer": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open_views()


def _two_numbers(action: Any) -> tuple[float, float]:
    """Two real numbers out of anything that holds no more and no less than these."""
    try:
        # Through plain Python values: a number is then told from text, bool or complex.
        values = np.asarray(action).tolist()
        a, delta = values
        if not (type(values) is list and type(a) in NUMBERS and type(delta) in NUMBERS):
            raise TypeError
        return float(a), float(delta)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"action must be two numbers [acceleration m/s^2, steering angle rad], not {action!r}"
        ) from None


def _load_vehicle(value: str | Path | VehicleParameters) -> VehicleParameters:
    return vehicle.load(value)


def _number(options: Mapping[str, Any], key: str, default: float) -> float:
    given = options.get(key, default)
    try:
        value = float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"reset option {key} must be a finite number, not {given!r}")
    return value
