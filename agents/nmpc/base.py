"""Common base of the NMPC agents: settings, weights, fallback after failed solves."""

import math
from abc import ABC
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from agents.base import DrivingTask, TrackingAgent, blind_control
from agents.classical.geometric import Stanley
from agents.nmpc.problem import HORIZON, PERIOD, NmpcProblem
from agents.nmpc.schedule import Switching
from agents.reference import local_reference
from agents.speed_cap import GRIP_SHARE
from agents.weights import FULL_SIZE, TrackingWeights, WeightSchedule, weights_from
from lpv_track_env.observation import ObservationLayout, TrackingObservation
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.tyres import FRICTION
from lpv_track_env.vehicle import VehicleParameters
from trajectories.arguments import Whole, check_fields, instance_of, numbers, shown
from trajectories.naming import choose

Array = NDArray[np.float64]
Memory = TypeVar("Memory")

FRICTIONS = ("known", "estimated", "linear")
"""Words for a coefficient of friction."""
ASPHALT = 0.8
"""Friction to begin with where tyres and road have no limit."""
FAILURES = Whole(0, 1_000_000_000)
GROWTH = 1.13
"""Factor from stage to stage: from 0.05 s on, 15 stages are 2 s, the last of them 0.27 s."""
SHORTEST_STAGE = 0.05
"""Length of the first stage, s, at shorter control periods."""


@dataclass(frozen=True, kw_only=True)
class NmpcSettings:
    """Settings of an NMPC agent.

    Parameters
    ----------
    horizon
        Number of stages N; by default as many as grow by about `GROWTH` each.
    stages
        Lengths of the stages, s: one number for all, or (N,). By default the first is as long as
        the control period, the others grow geometrically, and the last ends with the preview, or
        earlier for small vehicles (`stages_of`).
    weights
        Fixed weights, a schedule, or the file of a schedule. Either may be given as a mapping, too:
        `{"Q": [4 numbers], "S": [4], "R": [2], "R_rate": [2]}`, or a schedule in the form of its
        file. Once the settings are made, these are `TrackingWeights` or a `WeightSchedule`; None
        takes those of the vehicle's size, `TrackingWeights.of`.
    selection
        Rule by which a schedule chooses: "band" from the sharpest curvature in the preview at every
        step, or "path" once from the path's sharpest curvature, the paper's rule.
    model
        Prediction model and its constraints, by default the task's own vehicle.
    linear_penalty, quadratic_penalty
        Penalties of slack on (vx, vy, vx'), see `NmpcProblem`.
    friction
        Coefficient of friction of the model's tyres and, `GRIP_SHARE` of it, of the reference's
        acceleration: a number; "known", the environment's, of a range the least; "estimated",
        learned from how the vehicle moves (`friction`), by `lpv-nmpc` and `lpv-nmpc-tuned` alone;
        or "linear", neither has a limit.
    max_failures
        Failed solves in a row after which the vehicle is brought to a stop.

    Raises
    ------
    ValueError
        For an unknown selection, weights that cannot be used, or a file that cannot be read.
    """

    horizon: int | None = None
    stages: float | tuple[float, ...] | None = None
    weights: TrackingWeights | WeightSchedule | Mapping[str, Any] | str | Path | None = None
    selection: str = "band"
    model: VehicleParameters | None = None
    linear_penalty: tuple[float, float, float] = (20.0, 20.0, 0.0)
    quadratic_penalty: tuple[float, float, float] = (100.0, 100.0, 5.0)
    friction: float | str = "known"
    max_failures: int = 10

    def __post_init__(self) -> None:
        if not (isinstance(self.selection, str) and self.selection in {"band", "path"}):
            raise ValueError(f"selection must be 'band' or 'path', not {shown(self.selection)}")
        if self.horizon is not None:
            check_fields(self, {"horizon": HORIZON})
        if isinstance(self.stages, list | tuple | np.ndarray):
            size = len(self.stages) if self.horizon is None else self.horizon
            object.__setattr__(self, "stages", numbers("stages", self.stages, PERIOD, size))
        elif self.stages is not None:
            check_fields(self, {"stages": PERIOD})
        if self.model is not None:
            instance_of("model", self.model, VehicleParameters, "VehicleParameters or None")
        check_fields(self, {"max_failures": FAILURES})
        if isinstance(self.friction, str):
            choose("friction", self.friction, FRICTIONS)
        else:
            check_fields(self, {"friction": FRICTION})
        if self.weights is not None:
            object.__setattr__(self, "weights", weights_from(self.weights))

    def friction_in(self, task: DrivingTask) -> float:
        """Return the model's coefficient of friction for a task, or the largest estimate.

        inf is no limit.
        """
        if not isinstance(self.friction, str):
            return self.friction
        words = {
            "known": task.friction_range[0], "estimated": estimated_range(task)[1],
            "linear": math.inf,
        }  # fmt: skip
        return words[self.friction]


def estimated_range(task: DrivingTask) -> tuple[float, float]:
    """Return the range in which friction is estimated: the task's, or one about its only value."""
    low, high = task.friction_range
    if low < high:
        return low, high
    middle = low if low < math.inf else ASPHALT
    return 0.5 * middle, 1.5 * middle


@dataclass
class Fallback:
    """Memory of one vehicle's fallback, which replaces failed solves."""

    stanley: Any
    """Memory of Stanley's controller."""
    used: str = ""
    """Replacement in the last step: "plan", "stanley" or "stop", "" if the solve succeeded."""
    counts: Counter[str] = field(default_factory=Counter)
    """Failed solves by status, and replacements by name, in this episode."""


def growing_stages(first: float, total: float, count: int | None = None) -> tuple[float, ...]:
    """Return lengths of stages, s, of which each is longer than the one before by the same factor.

    Coarse stages far ahead see as far as many short ones. `first` is the length of the first stage,
    unless `count` stages of it would reach beyond `total`, the sum of all; by default so many
    stages that the factor is about `GROWTH`.
    """
    if count is None:
        count = max(math.ceil(math.log1p(total * (GROWTH - 1.0) / first) / math.log(GROWTH)), 1)
    if count == 1 or first * count >= total:
        return (total / count,) * count
    powers = np.arange(count)
    most = (total / first) ** (1.0 / (count - 1))
    factor = brentq(lambda q: first * float(np.sum(q**powers)) - total, 1.0, most)
    return tuple((first * factor**powers).tolist())


def stages_of(
    settings: NmpcSettings,
    layout: ObservationLayout,
    control_period: float,
    vehicle: VehicleParameters,
) -> tuple[float, ...]:
    """Return the lengths of an agent's stages, s, which the preview must cover.

    By default they cover it, but those of a vehicle with a wheelbase L under `FULL_SIZE` only
    sqrt(L/FULL_SIZE) of it: times of similar vehicles scale with the root of their size (Froude).
    Stages of up to 0.27 s, in which `f1tenth` turns by a radian, let it swing on small ovals.

    Raises
    ------
    ValueError
        If the preview is shorter.
    """
    period, seen = layout.preview_period, layout.preview_steps * layout.preview_period
    if settings.stages is None:
        covered = seen * math.sqrt(min(vehicle.wheelbase / FULL_SIZE, 1.0))
        return growing_stages(max(control_period, SHORTEST_STAGE), covered, settings.horizon)
    lengths = settings.stages
    if isinstance(lengths, float):
        most = max(int(seen / lengths + 1e-6), 1) if settings.horizon is None else settings.horizon
        lengths = (lengths,) * HORIZON.of("the number of stages", most)
    if sum(lengths) > seen * (1.0 + 1e-6):
        steps = math.ceil(sum(lengths) / period - 1e-6)
        raise ValueError(
            f"a horizon of {len(lengths)} stages, {sum(lengths):.4g} s, is longer than the preview "
            f"of {layout.preview_steps} steps of {period:g} s: make the environment with "
            f"preview_steps={steps}"
        )
    return lengths


class NmpcAgent(TrackingAgent[Memory], ABC):
    """Base of the NMPC agents.

    A failed solve is replaced by, in this order: the last plan's next input; once that plan is used
    up, Stanley's controller on the same observation; after `max_failures` failures in a row,
    braking with Stanley's steering. `diagnostics` names the replacement.

    Parameters
    ----------
    task
        Task of the agent.
    settings
        Settings of the agent.

    Raises
    ------
    ValueError
        If the horizon is longer than the preview, or a setting is out of range.
    """

    estimating = False
    """True for agents that can estimate friction."""

    def __init__(self, task: DrivingTask, settings: NmpcSettings) -> None:
        super().__init__(task)
        self.estimated = settings.friction == "estimated"
        if self.estimated and not self.estimating:
            raise ValueError(
                f"{type(self).__name__} cannot estimate friction, only lpv-nmpc and "
                "lpv-nmpc-tuned can: give a number, 'known' or 'linear'"
            )
        self.estimated_range = estimated_range(task) if self.estimated else (math.inf, math.inf)
        vehicle = settings.model or task.vehicle
        stages = stages_of(settings, task.layout, task.control_period, vehicle)
        self.problem = NmpcProblem(
            vehicle=vehicle,
            horizon=len(stages),
            stages=stages,
            first_period=task.control_period,
            linear_penalty=settings.linear_penalty,
            quadratic_penalty=settings.quadratic_penalty,
            friction=settings.friction_in(task),
        )
        self.grip = GRIP_SHARE * self.problem.friction * GRAVITY
        """Largest total acceleration of the reference, m/s^2."""
        self.preview_steps = self.problem.preview_steps(task.layout.preview_period)
        self.max_failures = settings.max_failures
        self._stanley = Stanley(task)
        self.rejected_weights = 0
        weights: Any = settings.weights
        if weights is None:
            weights = TrackingWeights.of(self.problem.vehicle)
        if isinstance(weights, WeightSchedule) and settings.selection == "path":
            weights = weights.for_path(task.path)
        self.switching = Switching(weights, task.control_period)

    def set_weights(self, weights: TrackingWeights | ArrayLike) -> bool:
        """Set weights, (12,) as Q, S, R, R_rate, from the next step on; the warm start is kept.

        They replace a schedule, too. Values out of bounds are clipped. A vector that is not finite,
        negative or of the wrong size is rejected: the weights stay as they are, `rejected_weights`
        counts it, and False is returned.
        """
        try:
            values = (
                weights
                if isinstance(weights, TrackingWeights)
                else TrackingWeights.from_array(weights)
            )
        except (ValueError, TypeError):
            self.rejected_weights += 1
            return False
        self.switching = Switching(values, self.task.control_period)
        return True

    @property
    def has_schedule(self) -> bool:
        """True if curvature chooses the weights at every step."""
        sets: int = self.switching.tables.shape[1]
        return sets > 1

    @property
    def fixed_weights(self) -> Array:
        """Q, S, R, R_rate in use without a schedule, (1, 12)."""
        weights: Array = self.switching.tables[:, 0]
        return weights

    def new_fallback(self) -> Fallback:
        """Create the fallback's memory of one vehicle, without any failed solve."""
        return Fallback(self._stanley.new_memory())

    def situation(self, observation: TrackingObservation) -> tuple[Array, Array, Array]:
        """Compute the problem's parameters, in the frame of the path's foot point.

        Returns
        -------
        state
            (6,) [vx, vy, psi, r, X, Y]: X is 0 and Y the lateral error.
        last_input
            (2,) [a, delta] in force, within their bounds.
        reference
            (N + 1, 4) [vx, psi, X, Y] at the horizon's nodes.
        """
        low, high = self.problem.input_bounds
        o = observation
        state = np.array(
            [o.longitudinal_speed, o.lateral_speed, o.heading_error, o.yaw_rate, 0.0,
             o.lateral_error]
        )  # fmt: skip
        last = np.array([o.acceleration, o.steering_angle]).clip(low, high)
        slowest, fastest = self.problem.vehicle.longitudinal_acceleration_range
        nodes = local_reference(
            o, self.task.layout.preview_period, self.problem.periods,
            leading=min(fastest, self.grip), grip=self.grip, braking=-slowest,
        )  # fmt: skip
        return state, last, np.stack([nodes.speed, nodes.heading, nodes.x, nodes.y], axis=-1)

    def replace(
        self,
        observation: TrackingObservation,
        fallback: Fallback,
        status: str,
        plan: Array | None,
        age: int,
        failures: int,
    ) -> tuple[float, float]:
        """Compute inputs (a, delta) in place of a failed solve.

        `NmpcAgent` gives the order of the replacements.

        Parameters
        ----------
        observation
            The vehicle's observation.
        fallback
            The vehicle's fallback, updated here.
        status
            Status of the failed solve.
        plan
            Inputs (N, 2) of the last plan, if any.
        age
            Control periods since that plan was made.
        failures
            Failed solves in a row, this one included.
        """
        fallback.counts[status] += 1
        # Stanley's memory is updated even where its inputs are not used.
        finite = all(np.isfinite(entry).all() for entry in observation)
        control = self._stanley.control if finite else self._stanley.control_blind
        a, delta = control(observation, fallback.stanley)
        ends = self.problem.times[1:]
        stage = int(np.searchsorted(ends, age * self.task.control_period + 1e-9, side="right"))
        if failures > self.max_failures:
            fallback.used = "stop"
            a, _ = blind_control(self.task.vehicle, observation)
        elif plan is not None and stage < len(plan):
            fallback.used = "plan"
            a, delta = (float(value) for value in plan[stage])
        else:
            fallback.used = "stanley"
        fallback.counts[fallback.used] += 1
        return a, delta
