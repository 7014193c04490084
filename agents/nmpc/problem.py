"""The optimal control problem of the LPV-NMPC, as mathematics that every solver implements.

State x = [vx, vy, psi, r, X, Y] and reference in the frame of the path's foot point, input
u = [a, delta], output y = C x = [vx, psi, X, Y] (kumar2025lpv, section III)::

    min   1/2 e_N' S e_N + sum_{i<N} h_i/T0 [ 1/2 (e_i' Q e_i + u_i' R u_i) + penalty(slack_i) ]
                         + sum_{i<N} d_i/T0   1/2 v_i' R_rate v_i
    e_i = T_i (reference_i - C x_i),  v_i = (u_i - u_{i-1}) / d_i    (u_{-1}: in force now)
    x_{i+1} = F(x_i, u_i)                        Runge-Kutta steps of x' = A(x, u) x + B(x, u) u
    |delta_i| <= delta_max,  a_min <= a_i <= a_max
    |delta_i - delta_{i-1}| <= d_i delta'_max,  |a_i - a_{i-1}| <= d_i a'_max
    vx_min <= vx_i <= vx_max        (soft)       i = 1..N
    |vy_i| <= ratio vx_i            (soft)       i = 1..N
    vx'_min <= vx'(x_i, u_i) <= vx'_max (soft)   i = 0..N-1

T_i turns the position's error to the reference's heading: so the weights on X and Y are those along
and across the path at the node. (With the paper's equal weights the two forms are the same.)

Stage i is h_i long, and d_i is the time from the middle of the stage before to its own middle; the
bound on the first change allows for one control period. The sums approximate integrals over time,
per T0 = 0.05 s, the period for which the weights were first chosen: so weights and penalties mean
the same for stages of any length and number. The paper's cost is that of stages of T0 without
R_rate, which it has not.

Every solver takes the weights as they are given; the agents schedule one of them over the measured
speed (`NmpcProblem.weights_at`). They add a weight on lateral jerk to that on the steering rate, so
that weights for brisk steering at 5 m/s do not make a fast car with stiff tyres weave.

A soft constraint may be violated by a slack s >= 0 at a cost of linear s + 1/2 quadratic s^2. This
penalty is exact for multipliers below `linear`, so slack is used only where the path demands the
impossible (the limit on vy alone bounds the curvature, see the errata). On vx' `linear` is 0 by
default: this limit gives way a little.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.weights import WEIGHTS
from lpv_track_env import tyres
from lpv_track_env.bicycle import fastest_pole
from lpv_track_env.observation import MOST_STEPS
from lpv_track_env.vehicle import VehicleParameters
from trajectories.arguments import Number, Whole, check_fields, numbers

Array = NDArray[np.float64]

STATES, INPUTS, OUTPUTS, SOFT = 6, 2, 4, 3
NOMINAL_PERIOD = 0.05
"""T0, s: a stage of this length has the cost of its weights."""
STEERING_GAIN = 30.0
"""Gain of lateral acceleration by steering angle, m/s^2, at which the weight on the steering rate
is twice that at standstill."""
RK4_STABILITY = 2.78
"""Largest product of step and pole for which classic Runge-Kutta is stable (real poles)."""
HORIZON = Whole(1, MOST_STEPS)
"""Rule of the number of stages."""
PERIOD, PENALTY = Number(0.0, 10.0, "s", above=True), Number(0.0, 1e12)


LARGEST = 1e9
"""Largest magnitude, in SI units, of a number that solves start from."""


def steering_rate_factor(vx: float, wheelbase: float, understeer: float) -> float:
    """Return the factor of the weight on the steering rate at a speed vx, m/s.

    It is 1 + (G / `STEERING_GAIN`)^2 with the steady gain G = vx^2 / (L + K vx^2) of the lateral
    acceleration (Rajamani, Vehicle Dynamics and Control, section 3.3): its second part weighs
    (G delta')^2, lateral jerk. An oversteering car's gain is bounded by 2 vx^2 / L.
    """
    squared = vx * vx
    gain = squared / max(wheelbase + understeer * squared, 0.5 * wheelbase)
    return 1.0 + (gain / STEERING_GAIN) ** 2


class Status(Enum):
    """Result of a solve, in acados's vocabulary; NAN also for parameters beyond `LARGEST`."""

    SUCCESS = "SUCCESS"
    MAXITER = "MAXITER"
    INFEASIBLE = "INFEASIBLE"
    NAN = "NAN"
    TIMEOUT = "TIMEOUT"
    QP_FAILURE = "QP_FAILURE"


@dataclass(frozen=True)
class NmpcProblem:
    """Dimensions, bounds and penalties of the problem; every solve takes its own weights.

    Parameters
    ----------
    vehicle
        Prediction model and its constraints.
    horizon
        Number of stages, N.
    period
        Length of a stage, s.
    stages
        Lengths of the stages, (N,) s, where they differ.
    first_period
        Time until the next plan, s, over which the change of the first input is bounded; by default
        the first stage's length.
    linear_penalty, quadratic_penalty
        Penalties of slack on (vx m/s, vy m/s, vx' m/s^2), shape (3,). That on vx' is small: a car
        that it holds back from its place along the path would steer to gain on it.
    friction
        Coefficient of friction of the model's tyres (`lpv_track_env.tyres`); inf makes them linear.

    Raises
    ------
    ValueError
        For a horizon below 1, a period that is not positive, another number of stages, or a
        negative penalty.
    """

    vehicle: VehicleParameters
    horizon: int = 20
    period: float = 0.1
    stages: tuple[float, ...] | None = None
    first_period: float | None = None
    linear_penalty: tuple[float, float, float] = (20.0, 20.0, 0.0)
    quadratic_penalty: tuple[float, float, float] = (100.0, 100.0, 5.0)
    friction: float = math.inf

    def __post_init__(self) -> None:
        rules: dict[str, Number | Whole] = {
            "horizon": HORIZON, "period": PERIOD, "friction": tyres.FRICTION,
        }  # fmt: skip
        if self.first_period is not None:
            rules["first_period"] = PERIOD
        check_fields(self, rules)
        if self.stages is not None:
            stages = numbers("stages", self.stages, PERIOD, self.horizon)
            object.__setattr__(self, "stages", stages)
        for name in ("linear_penalty", "quadratic_penalty"):
            object.__setattr__(self, name, numbers(name, getattr(self, name), PENALTY, 3))

    def parameters(
        self, state: Array, last_input: Array, reference: Array, weights: Array
    ) -> Array | None:
        """Pack what a solve depends on into a vector; None if it is beyond all arithmetic.

        That is the state (6,), the input in force (2,), the reference (N + 1, 4) and the weights
        (12,), of which each number must be finite and at most `LARGEST`.

        Raises
        ------
        ValueError
            For another shape.
        """
        given = {"state": state, "last_input": last_input, "reference": reference,
                 "weights": weights}  # fmt: skip
        shapes = (STATES,), (INPUTS,), (self.horizon + 1, OUTPUTS), (WEIGHTS,)
        for (name, value), shape in zip(given.items(), shapes, strict=True):
            if np.shape(value) != shape:
                raise ValueError(f"{name} must have shape {shape}, not {np.shape(value)}")
        packed = np.concatenate([np.ravel(value) for value in given.values()])
        return packed if (np.abs(packed) <= LARGEST).all() else None  # NaN is not, either

    def weights_at(self, weights: Array, vx: float) -> Array:
        """Return weights (12,) scheduled over the speed vx, m/s: a copy."""
        car, scheduled = self.vehicle, weights.copy()
        vx = min(abs(vx), car.speed_range[1])
        scheduled[-1] *= steering_rate_factor(vx, car.wheelbase, car.understeer_gradient)
        return scheduled

    @property
    def periods(self) -> Array:
        """Length of each stage, (N,) s."""
        given = self.period if self.stages is None else self.stages
        return np.broadcast_to(np.array(given, dtype=np.float64), (self.horizon,)).copy()

    @property
    def times(self) -> Array:
        """Times of the nodes, (N + 1,) s."""
        return np.concatenate([[0.0], np.cumsum(self.periods)])

    def preview_steps(self, period: float) -> int:
        """Return how many intervals of a preview, each of `period` s, the stages reach into."""
        return math.ceil(float(self.times[-1]) / period - 1e-6)

    @property
    def substeps(self) -> NDArray[np.int64]:
        """Runge-Kutta steps of each stage (N,), for stability at any speed.

        The lateral poles are fastest at standstill, from which a plan may have to drive off.
        """
        pole = fastest_pole(0.0, self.vehicle)
        return np.ceil(self.periods * (pole / RK4_STABILITY)).astype(np.int64)

    @property
    def spacings(self) -> Array:
        """Time from the middle of the input before to the middle of each stage's input, (N,) s."""
        periods, first = self.periods, self.first_period
        before: Array = np.append(periods[0] if first is None else first, periods[:-1])
        return 0.5 * (periods + before)

    @property
    def passed(self) -> Array:
        """Share of each stage that has passed when the next plan is made, (N,)."""
        periods, first = self.periods, self.first_period
        shares: Array = np.minimum((periods[0] if first is None else first) / periods, 1.0)
        return shares

    @property
    def input_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bound of u, each (2,): accelerations that the tyres follow, too."""
        low, high = self.vehicle.acceleration_range
        if self.friction < math.inf:
            most = tyres.FULL * tyres.of(self.vehicle, self.friction)[0]
            low, high = max(low, -most), min(high, most)
        limit = self.vehicle.max_steering_angle
        return np.array([low, -limit]), np.array([high, limit])

    @property
    def input_steps(self) -> Array:
        """Largest change of u at the start of each stage, (N, 2)."""
        times = self.spacings
        times[0] = self.periods[0] if self.first_period is None else self.first_period
        return np.outer(times, [self.vehicle.max_jerk, self.vehicle.max_steering_rate])


class Solution(NamedTuple):
    """Result of a solve.

    `inputs` (N, 2) and `states` (N + 1, 6) are the plan, or None if there is no valid one; `slack`
    (N, 3) are its violations of the soft constraints on vx, vy and vx'.
    """

    status: Status
    inputs: Array | None = None
    states: Array | None = None
    slack: Array | None = None
    cost: float = math.nan
    iterations: int = 0
    seconds: float = 0.0
