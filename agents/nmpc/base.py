"""What every NMPC agent has, whatever solves its problem: settings, weights, failure ladder."""

from abc import ABC
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.base import DrivingTask, TrackingAgent
from agents.classical.geometric import Stanley
from agents.nmpc.problem import NmpcProblem
from agents.nmpc.schedule import Switching
from agents.reference import local_reference
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.observation import TrackingObservation
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]
Memory = TypeVar("Memory")


@dataclass
class Ladder:
    """What is remembered of one vehicle for when solves fail."""

    stanley: Any
    """Memory of the fallback controller."""
    fallback: str = ""
    """What replaced a failed solve in the last step: "", "plan", "stanley" or "stop"."""
    counts: Counter[str] = field(default_factory=Counter)
    """Failed solves by status, and fallbacks by name, in this episode."""


class NmpcAgent(TrackingAgent[Memory], ABC):
    """Settings that the NMPC agents share; see `RtiNmpc` for their meaning."""

    def __init__(
        self,
        task: DrivingTask,
        *,
        horizon: int | None,
        weights: TrackingWeights | WeightSchedule | str | Path | None,
        selection: str,
        model: VehicleParameters | None,
        linear_penalty: tuple[float, float, float],
        quadratic_penalty: tuple[float, float, float],
        max_failures: int,
    ) -> None:
        super().__init__(task)
        steps = task.layout.preview_steps
        horizon = steps if horizon is None else horizon
        if horizon > steps:
            raise ValueError(
                f"horizon {horizon} is longer than the preview of {steps} steps: "
                f"make the environment with preview_steps={horizon}"
            )
        if selection not in {"band", "path"}:
            raise ValueError(f"selection must be 'band' or 'path', not {selection!r}")
        self.problem = NmpcProblem(
            vehicle=model or task.vehicle,
            horizon=horizon,
            period=task.layout.preview_period,
            first_period=task.control_period,
            linear_penalty=linear_penalty,
            quadratic_penalty=quadratic_penalty,
        )
        self.max_failures = max_failures
        self._fallback = Stanley(task)
        self.rejected_weights = 0
        if isinstance(weights, str | Path):
            weights = WeightSchedule.read(Path(weights))
        if not isinstance(weights, TrackingWeights | WeightSchedule | None):
            raise ValueError(  # noqa: TRY004  a setting, as every other
                f"weights must be weights, a schedule or its file, not {type(weights).__name__}"
            )
        if isinstance(weights, WeightSchedule) and selection == "path":
            weights = weights.for_path(task.path)
        self.switching = Switching(weights or TrackingWeights(), task.control_period)

    def set_weights(self, weights: TrackingWeights | ArrayLike) -> bool:
        """Take new weights, (10,) as Q, S, R, from the next step on; the warm start is kept.

        A schedule is followed no longer then. Values out of bounds are clipped to them; a vector
        that is not finite, negative or of the wrong size is refused: the weights stay,
        `rejected_weights` counts it, False is returned.
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
        """Whether weights are chosen by curvature at every step."""
        sets: int = self.switching.tables.shape[1]
        return sets > 1

    @property
    def fixed_weights(self) -> Array:
        """Q, S, R in use where no schedule chooses, (1, 10)."""
        weights: Array = self.switching.tables[:, 0]
        return weights

    def new_ladder(self) -> Ladder:
        """For a vehicle that no solve has failed for."""
        return Ladder(self._fallback.new_memory())

    def situation(self, observation: TrackingObservation) -> tuple[Array, Array, Array]:
        """The problem's parameters from an observation, in the frame of the path's foot point.

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
            [
                o.longitudinal_speed,
                o.lateral_speed,
                o.heading_error,
                o.yaw_rate,
                0.0,
                o.lateral_error,
            ]
        )
        last = np.array([o.acceleration, o.steering_angle]).clip(low, high)
        nodes = local_reference(o, self.problem.period)
        stacked = np.stack([nodes.speed, nodes.heading, nodes.x, nodes.y], axis=-1)
        return state, last, stacked[: self.problem.horizon + 1]

    def replace(
        self,
        observation: TrackingObservation,
        ladder: Ladder,
        status: str,
        plan: Array | None,
        age: int,
        failures: int,
    ) -> tuple[float, float]:
        """Inputs in place of a failed solve: the next rung of the ladder.

        Parameters
        ----------
        observation
            Of one vehicle.
        ladder
            Of this vehicle.
        status
            Of the failed solve.
        plan
            The last plan that was solved, inputs (N, 2), if any.
        age
            Control periods since that plan was made.
        failures
            Failed solves in a row, this one included.
        """
        ladder.counts[status] += 1
        # Kept up to date on every rung, since Stanley's own memory belongs to a driven episode.
        seen = all(np.isfinite(entry).all() for entry in observation)
        fallback = self._fallback.control if seen else self._fallback.control_blind
        a, delta = fallback(observation, ladder.stanley)
        stage = int(age * self.task.control_period / self.problem.period + 1e-9)
        if failures > self.max_failures:
            ladder.fallback = "stop"
            a, _ = super().control_blind(observation, None)  # type: ignore[arg-type]
        elif plan is not None and stage < len(plan):
            ladder.fallback = "plan"
            a, delta = (float(value) for value in plan[stage])
        else:
            ladder.fallback = "stanley"
        ladder.counts[ladder.fallback] += 1
        return a, delta
