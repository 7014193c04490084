"""`lpv_track_env/PathTracking-v0`: drive a reference path with acceleration and steering."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lpv_track_env import episodes, kernels, plants
from lpv_track_env.conditions import Actuation, Conditions
from lpv_track_env.conditions import episode as conditions_episode
from lpv_track_env.conditions import load as load_conditions
from lpv_track_env.conditions.layout import FRICTION, ConditionedVehicle, info_of
from lpv_track_env.draws import random_key
from lpv_track_env.episodes import ENDS, INFO, single_info
from lpv_track_env.observation import PREVIEW_PERIOD, PREVIEW_STEPS, ObservationLayout
from lpv_track_env.plants import PlantEpisode
from lpv_track_env.reference import SpeedChoice, reference
from lpv_track_env.reward import RewardWeights
from lpv_track_env.task import Task, action_space, checked_period
from lpv_track_env.validation import (
    check_finite,
    checked_options,
    checked_seed,
    given_start,
    names_unknown,
    two_numbers,
)
from lpv_track_env.vehicle import VehicleParameters
from lpv_track_env.vehicle import load as load_vehicle
from trajectories import ReferencePath
from trajectories.arguments import shown
from trajectories.compilation import entry_point
from trajectories.naming import choose

if TYPE_CHECKING:
    from lpv_track_env.rendering import Renderer

RESET_OPTIONS = ("trajectory", "vehicle", *episodes.GIVEN)


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
    rate). An action that is not finite, or of the wrong shape or type, raises a ValueError and
    leaves the episode untouched.

    ## Observation space

    `Box(float32, (8 + 2 K,))`: velocities, yaw rate, actuators, errors, and curvature and speed of
    the reference over K periods, see `lpv_track_env.observation`. Values saturate at their bounds.

    ## Reward

    Sum of named terms, see `lpv_track_env.reward`, in `info["reward_progress"]` and so on: lateral,
    heading, speed, input_rate, end. Perfect tracking gives 1 per second.

    ## Episode end

    `terminated`, with `info["end"]`:

    | end | when |
    |---|---|
    | `finished` | the foot point reaches the end of the path (a closed path: after one lap) |
    | `left_corridor` | lateral error over `max_lateral_error` |
    | `wrong_heading` | heading error over 90 degrees |
    | `non_finite` | the state is no longer finite (the last finite one is kept) |

    `truncated`, with `info["end"] = "time_limit"`, at the time limit only.

    ## Starting state

    On the path at its start, at the reference speed, in the steady turn of its curvature.
    `initial_error_range` gives drawn errors in lateral offset (m), heading (rad) and speed (m/s);
    `random_start` draws the arc length, too. `reset(seed=...)` seeds `self.np_random` and takes one
    key from it; an episode depends on this key and its number (`lpv_track_env.episodes`), so
    environment i of a `PathTrackingVectorEnv` reset with seed s equals this one reset with s + i.

    `reset(options=...)` takes `trajectory`, `vehicle` (both as in the arguments), `arc_length` (m),
    `lateral_error` (m), `heading_error` (rad), and `speed_error` or `speed` (m/s), for one episode.
    A speed below standstill raises a ValueError, and brakes hold a vehicle there, unless its
    `speed_range` begins below 0: such a vehicle reverses.

    ## Info

    `lateral_error, heading_error, speed_error, arc_length, state` (true state, (6,): vx, vy, psi,
    r, X, Y), `clipped`, the reward's terms and `end` ("" until it ends). Under conditions the
    observation is made from an estimate, and there are `estimate` (6,), `position_deviation` (m, of
    the filter in the worst direction; 0 without one), `stopping` (the vehicle brakes, since fixes
    or commands are overdue) and `deadline_misses`. Keys, types and shapes never change.

    ## Arguments

    trajectory
        A name (`trajectories.names()`), a file, or a `ReferencePath`.
    vehicle
        A preset's name (`lpv_track_env.vehicle.VEHICLES`), a .json file or `VehicleParameters`.
    speed_mode, fixed_speed, grip
        "variable": the path's own speeds. "fixed": one, by default the highest within its limits.
        "grip": the fastest profile of the vehicle that uses this share of the grip that the nominal
        friction gives (`lpv_track_env.reference`).
    conditions
        "simulation" (perfect actuators, sensors, knowledge of the vehicle), "realtime" (our model
        of a vehicle's runs), a `lpv_track_env.conditions.Conditions`, or a dictionary of its
        fields, e.g. `{"name": "realtime", "estimator": "raw"}`; ranges are drawn every episode.
    control_period
        s; the dynamics are integrated with fixed Runge-Kutta steps of at most 5 ms within it.
    preview_steps, preview_period
        K and the spacing of the preview, s.
    reward_weights
        `lpv_track_env.reward.RewardWeights`.
    max_lateral_error
        Half width of the corridor, m.
    time_limit
        s; by default one and a half times the path's duration plus 10 s.
    plant
        Model of the driven vehicle: "bicycle", one of `lpv_track_env.plants` ("single-track",
        "drift", "multi-body"), or a function of `VehicleParameters` that returns a `Plant`.
    render_colour
        Colour of the path in frames: by "speed", the reference's, or by "curvature".

    ## Version history

    v0: first version.
    """

    # An instance has its own `render_fps`: one frame per control period.
    metadata: dict[str, Any] = {  # noqa: RUF012  declared so by gymnasium.Env
        "render_modes": ["human", "rgb_array"],
        "render_fps": 20,
    }

    @names_unknown
    def __init__(
        self,
        trajectory: str | Path | ReferencePath = "T1",
        vehicle: str | Path | VehicleParameters = "m2-minibus",
        speed_mode: str = "variable",
        fixed_speed: float | None = None,
        conditions: str | Conditions | dict[str, Any] = "simulation",
        control_period: float = 0.05,
        render_mode: str | None = None,
        grip: float | None = None,
        *,
        preview_steps: int = PREVIEW_STEPS,
        preview_period: float = PREVIEW_PERIOD,
        reward_weights: RewardWeights | None = None,
        max_lateral_error: float = 5.0,
        time_limit: float | None = None,
        initial_error_range: tuple[float, float, float] = (0.0, 0.0, 0.0),
        random_start: bool = False,
        plant: str | plants.Factory = plants.BICYCLE,
        render_colour: str = "speed",
    ) -> None:
        self._render_colour = choose("render_colour", render_colour, ("speed", "curvature"))
        if render_mode is not None:
            choose("render_mode", render_mode, tuple(self.metadata["render_modes"]))
        self.render_mode = render_mode
        self._speed = SpeedChoice(speed_mode, fixed_speed, grip)
        car, given = load_vehicle(vehicle), load_conditions(conditions)
        period = checked_period(control_period)
        self.plant = plant
        self.base_task = Task(
            path=reference(trajectory, car, self._speed, plant, given),
            vehicle=car,
            control_period=period,
            layout=ObservationLayout(preview_steps, preview_period),
            reward_weights=RewardWeights() if reward_weights is None else reward_weights,
            max_lateral_error=max_lateral_error,
            time_limit=time_limit,
            initial_error_range=initial_error_range,
            random_start=random_start,
            conditions=given,
        )
        fps = max(round(1.0 / self.base_task.control_period), 1)
        self.metadata = {**self.metadata, "render_fps": fps}
        bound = self.base_task.layout.bound
        self.observation_space = spaces.Box(-bound, bound, dtype=np.float32)
        self.action_space = action_space([car])
        self._episode_data = np.zeros(kernels.OBSERVATION + self.base_task.layout.size // 2)
        self._running = False
        self._draws = np.zeros(2, dtype=np.uint64)
        self._key, self._episode = np.uint64(0), -1
        self._conditioned: ConditionedVehicle | None = None
        self._renderer: Renderer | None = None
        self._open_views()
        self._use(self.base_task, self._plant_of(self.base_task))
        slippery = self.conditions is not None and self.conditions.middle("friction") < math.inf
        if slippery and self.friction == math.inf:
            message = f"conditions: friction has no effect on plant {shown(plant)}: linear tyres"
            warnings.warn(message, UserWarning, stacklevel=3)

    def _open_views(self) -> None:
        """Make views of the episode's array once, since making one takes as long as a copy."""
        data = self._episode_data
        self._record = data[kernels.RECORD : kernels.CONSTANTS]
        self._state = self._record[:6]
        self._constants = data[kernels.CONSTANTS : kernels.OBSERVATION]
        self._observation = data[kernels.OBSERVATION :].view(np.float32)
        # Writing Python numbers through a memoryview takes half the time.
        self._command: Any = data.data

    def _use(self, task: Task, plant: PlantEpisode | None) -> None:
        if getattr(self, "task", None) is task:
            return
        self.task, self._plant = task, plant
        self._constants[:] = task.constants()
        self._conditioned = None
        if task.conditions is not None:
            self._conditioned = ConditionedVehicle.of(
                task.conditions, task.vehicle, task.control_period, self.friction
            )
        self._take_table(task.path.table)

    def _plant_of(self, task: Task) -> PlantEpisode | None:
        if getattr(self, "task", None) is task:
            return self._plant
        return plants.episode_of(self.plant, task.vehicle)

    def _take_table(self, table: NDArray[np.float64]) -> None:
        self._table = table
        self._arguments: tuple[NDArray[Any], ...] = (self._episode_data, table)
        if self._conditioned is not None:
            self._arguments = (self._episode_data, table, *self._conditioned, self._draws)
        self._advance: Callable[..., Any] = self._first_advance

    def _first_advance(self, *arguments: NDArray[Any]) -> Any:
        """Find the kernel of the first step, compile it if need be, and call it."""
        if self._plant is not None:
            self._advance = self._plant.advance
        elif self._conditioned is not None:
            self._advance = entry_point(conditions_episode.advance_under_conditions, *arguments)
        else:
            self._advance = entry_point(kernels.advance, *arguments)
        return self._advance(*arguments)

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
    def conditions(self) -> Conditions | None:
        """The conditions; None for "simulation"."""
        return self.base_task.conditions

    @property
    def actuation(self) -> Actuation:
        """Nominal delays and lags between a command and its effect (s)."""
        return Actuation() if self.conditions is None else self.conditions.actuation

    @property
    def friction_range(self) -> tuple[float, float]:
        """Least and largest friction of tyres and road, inf without a limit."""
        return plants.friction_range(self._plant, self.conditions)

    @property
    def friction(self) -> float:
        """Nominal friction of tyres and road: the middle of its range, inf without a limit."""
        return 0.5 * sum(self.friction_range)

    @property
    def road_friction(self) -> float:
        """Friction of tyres and road where the vehicle is, as drawn; inf without a limit."""
        return plants.road_friction(self._plant, self._conditioned, self._record, self._constants)

    @property
    def actuators(self) -> tuple[float, float]:
        """Acceleration (m/s^2) and steering angle (rad) in force at the actuators."""
        return float(self._record[kernels.ACCELERATION]), float(self._record[kernels.STEERING])

    @property
    def controller_busy(self) -> bool:
        """True while the controller computes an earlier action: the next one will be dropped."""
        now = float(self._record[kernels.STEPS] * self.control_period)
        return self._conditioned is not None and self._conditioned.busy_at(now)

    def set_computing_time(self, latency: float, occupied: float | None = None) -> None:
        """Set the computing time of the next step's action, in place of `computing_delay`.

        Parameters
        ----------
        latency
            Time from the readings to the command, s.
        occupied
            Time for which the controller is busy, s; by default `latency`. A pipeline of processes
            is busy for less time than its latency.

        Raises
        ------
        ValueError
            Under conditions "simulation", which have no delays, or for a negative time.
        """
        if self._conditioned is None:
            raise ValueError("conditions 'simulation' have no delays: make the env with others")
        self._conditioned.set_computing_time(latency, latency if occupied is None else occupied)

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
        options, seed = checked_options(options, RESET_OPTIONS), checked_seed(seed)
        task = self.episode_task(options)
        given = given_start(options, task.path.length)
        task.check_start(given)
        plant = self._plant_of(task)
        # All is checked: from here on the last episode is gone.
        super().reset(seed=seed)
        self._count_episode(reseeded=seed is not None)
        self._use(task, plant)
        own = plants.friction_range(plant, None)[0]
        if self._conditioned is None:
            episodes.begin(
                self._record, self._constants, self._table, self._observation,
                self._key, self._episode, given, own,
            )  # fmt: skip
        else:
            self._draws[:] = self._key, self._episode
            conditions_episode.begin_under_conditions(
                self._conditioned.vehicle, self._record, self._conditioned.spec, self._constants,
                self._table, self._observation, self._draws, given, own,
            )  # fmt: skip
        if plant is not None:
            drawn = math.inf if self._conditioned is None else self._conditioned.vehicle[FRICTION]
            plant.begin(self._record, float(drawn))
        self._running = True
        self._begin_drawing()
        if self.render_mode == "human":
            self.render()
        info = single_info(self._record)
        if self._conditioned is not None:
            info.update(info_of(self._conditioned.vehicle))
        return self._observation.copy(), info

    def _count_episode(self, *, reseeded: bool) -> None:
        """Take a new key from `np_random` if it was seeded, else count the next episode."""
        if reseeded or self._episode < 0:
            self._key = random_key(self.np_random)
            self._episode = 0
        else:
            self._episode += 1

    def episode_task(self, options: Mapping[str, Any]) -> Task:
        """Return the task of an episode with reset options `trajectory` and `vehicle`, if given."""
        if not {"trajectory", "vehicle"} & set(options):
            return self.base_task
        car = load_vehicle(options.get("vehicle", self.base_task.vehicle))
        path = options.get("trajectory", self.base_task.path)
        if "trajectory" in options or self._speed.mode == "grip":
            path = reference(path, car, self._speed, self.plant, self.conditions)
        return replace(self.base_task, path=path, vehicle=car)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive one control period; see the class for actions, rewards, ends and errors."""
        if not self._running:
            raise gymnasium.error.ResetNeeded(
                "the episode has not begun or has ended: call reset() before step()"
            )
        # Most of a step's time outside the kernel is spent here: few operations for the usual
        # action, checks for any other. A refused action leaves the episode untouched.
        values = action.tolist() if type(action) is np.ndarray else action
        if type(values) is list and len(values) == 2:
            a, delta = values
        else:
            a, delta = two_numbers(action)
        if type(a) is not float or type(delta) is not float:
            a, delta = two_numbers(action)
        command = self._command
        command[0] = a
        command[1] = delta
        # Copying and filling a dictionary is faster than writing a new one.
        info = INFO.copy()
        (
            end, info["arc_length"], info["lateral_error"], info["heading_error"],
            info["speed_error"], info["clipped"], reward, info["reward_progress"],
            info["reward_lateral"], info["reward_heading"], info["reward_speed"],
            info["reward_input_rate"], info["reward_end"],
        ) = self._advance(*self._arguments)  # fmt: skip
        info["state"] = self._state.copy()
        if self._conditioned is not None:
            info.update(info_of(self._conditioned.vehicle))
        terminated = truncated = False
        if end:
            if end == kernels.NOT_FINITE:
                check_finite(a, delta, action)
            info["end"] = ENDS[end]
            truncated = end == kernels.TIME_LIMIT
            terminated = not truncated
            self._running = False
        if self.render_mode is not None:
            if self._renderer is not None:
                self._renderer.follow(self._record)
            if self.render_mode == "human":
                self.render()
        return self._observation.copy(), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene: a frame (600, 900, 3) uint8 for "rgb_array", a window for "human"."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='human' or 'rgb_array'")
            return None
        if self._episode < 0:
            raise gymnasium.error.ResetNeeded(
                "the episode has not begun: call reset() before render()"
            )
        return self._open_renderer(self.render_mode).draw(self._record)

    def _begin_drawing(self) -> None:
        """Announce a new episode to the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.begin(self.task)

    def _open_renderer(self, render_mode: str) -> "Renderer":
        if self._renderer is None:
            from lpv_track_env.rendering import Renderer

            self._renderer = Renderer(render_mode, self.metadata["render_fps"], self._render_colour)
            self._begin_drawing()
        return self._renderer

    def draw(
        self, task: Task, record: NDArray[np.float64], notes: Mapping[str, str] | None = None
    ) -> NDArray[np.uint8]:
        """Draw an episode of another environment and `notes`: a frame (600, 900, 3) uint8."""
        renderer = self._open_renderer("rgb_array")
        renderer.begin(task)
        renderer.notes = notes or {}
        frame = renderer.draw(record)
        assert frame is not None
        return frame

    def show_agent(
        self, plan: NDArray[np.float64] | None = None, notes: Mapping[str, str] | None = None
    ) -> None:
        """Draw an agent's plan and notes from now on, in place of earlier ones.

        `plan`: predicted positions, (n, 2) m in the world; `notes`: one row of text for each label.
        """
        if self.render_mode is not None:
            renderer = self._open_renderer(self.render_mode)
            renderer.plan, renderer.notes = plan, notes or {}

    def close(self) -> None:
        """Close the window, if any."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        # Copies of the views would not refer to the copied array.
        views = {"_record", "_state", "_constants", "_observation", "_command"}
        compiled = {"_arguments", "_advance"}
        kept = {
            name: value for name, value in self.__dict__.items() if name not in views | compiled
        }
        return {**kept, "_renderer": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open_views()
        self._take_table(self._table)
