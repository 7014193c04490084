"""Optimal control of the brush bicycle over a grid of places, transcribed for IPOPT.

The plant's own vector field is integrated by classic Runge-Kutta steps, as the environment does it,
from node to node (multiple shooting). The time of an interval is a variable, so that nodes can stay
at fixed places: cones and the sides of a corridor are then bounds on states. Inputs are held over
an interval and keep the range of the actuators; at its begin they change by no more than rate or
jerk times its length, as the environment's actuators do in a control period. Nothing else limits
them: what is found no controller can surpass on this plant, save for other local optima.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from lpv_track_env import tyres
from lpv_track_env.bicycle import (
    ACTION_SIZE,
    STATE_SIZE,
    VX,
    casadi_derivative,
    longest_substep,
)
from lpv_track_env.integration import integrate_with
from lpv_track_env.vehicle import VehicleParameters
from trajectories.compilation import compiled

Array = NDArray[np.float64]

SLOWEST = 2.0
"""m/s: lowest speed of a motion; below, wheels turn too slowly for the tyres' model."""
LONGEST_STEP = 0.01
"""Longest Runge-Kutta step at the guess, s; at speeds above `SLOWEST` its error is below 1e-6."""
TOLERANCE = 1e-8
ITERATIONS = 600
SMOOTHNESS = 1e-6
"""Weight of the mean squared rates of the inputs, shares of the largest ones, in the cost: without
it a motion is not unique where nothing limits it."""
SCALE = np.array([10.0, 1.0, 0.3, 0.3, 30.0, 3.0, 3.0, 0.1])
"""Sizes of states and inputs, by which variables are scaled."""
STATE_COLUMN, INPUT_COLUMN = slice(0, STATE_SIZE), slice(STATE_SIZE, STATE_SIZE + ACTION_SIZE)


@dataclass(frozen=True)
class Motion:
    """A motion of n intervals: their lengths (n,) s, states (n + 1, 6) and inputs (n, 2)."""

    steps: Array
    state: Array
    inputs: Array

    @property
    def time(self) -> Array:
        """Times of the nodes, (n + 1,) s."""
        return np.concatenate([[0.0], np.cumsum(self.steps)])


@dataclass(frozen=True)
class Outcome:
    """Result of a solve; `value` is the cost without `SMOOTHNESS`, `status` IPOPT's own."""

    motion: Motion
    value: float
    status: str
    iterations: int
    seconds: float

    @property
    def solved(self) -> bool:
        """True if IPOPT has found a local optimum."""
        return self.status in {"Solve_Succeeded", "Solved_To_Acceptable_Level"}


class ControlProblem:
    """An optimal control problem; add constraints with `require`, bounds in `lower` and `upper`.

    Parameters
    ----------
    vehicle, friction
        The plant: a bicycle with brush tyres of this coefficient of friction.
    guess
        A motion to start from; it fixes the number of intervals, and by its longest interval the
        number of Runge-Kutta steps in each.
    periodic
        True: the inputs before the first interval are those of the last. Otherwise they are those
        of an environment's start on a straight: no steering, acceleration that holds the speed.
    """

    def __init__(
        self, vehicle: VehicleParameters, friction: float, guess: Motion, *, periodic: bool
    ) -> None:
        self.vehicle, self.friction, self.guess = vehicle, friction, guess
        n = len(guess.steps)
        self._typical = float(np.mean(guess.steps))
        self.substeps = math.ceil(guess.steps.max() / LONGEST_STEP - 1e-9)
        stage = STATE_SIZE + ACTION_SIZE + 1
        self._scale = np.concatenate([SCALE, [self._typical]])
        self._variables = ca.MX.sym("variables", n * stage + STATE_SIZE + 1)
        self._stages = ca.reshape(self._variables[: n * stage], stage, n)
        last = self._variables[n * stage : -1]
        self.extra = self._variables[-1]
        """A variable of its own, unscaled; 0 unless its range is changed."""
        values = ca.diag(self._scale) @ self._stages
        self.states = ca.horzcat(values[STATE_COLUMN, :], ca.diag(SCALE[STATE_COLUMN]) @ last)
        self.inputs, self.steps = values[INPUT_COLUMN, :], values[-1, :]
        self._rows: list[tuple[Any, Any, Any]] = []
        self.lower = np.full((n + 1, stage), -np.inf)
        self.upper = np.full((n + 1, stage), np.inf)
        self.extra_range = (0.0, 0.0)
        low, high = vehicle.acceleration_range
        most = vehicle.max_steering_angle
        self.lower[:, VX] = SLOWEST
        self.lower[:, STATE_SIZE:] = (low, -most, 0.1 * self._typical)
        self.upper[:, STATE_SIZE:] = (high, most, 10.0 * self._typical)
        self._step = self._stage_step()
        self._add_rates(periodic=periodic)

    def _stage_step(self) -> ca.Function:
        """Build F(z): the state, in units of its scale, at the end of a stage z of variables."""
        z = ca.SX.sym("z", len(self._scale))
        values = self._scale * z
        x, u, dt = values[STATE_COLUMN], values[INPUT_COLUMN], values[-1]
        symbols = ca.SX.sym("x", STATE_SIZE), ca.SX.sym("u", ACTION_SIZE)
        rate = casadi_derivative(*symbols, self.vehicle, self.friction)
        field, state, h = ca.Function("field", symbols, [rate]), x, dt / self.substeps
        for _ in range(self.substeps):
            k1 = field(state, u)
            k2 = field(state + 0.5 * h * k1, u)
            k3 = field(state + 0.5 * h * k2, u)
            k4 = field(state + h * k3, u)
            state = state + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return ca.Function("F", [z], [state / SCALE[STATE_COLUMN]])

    def _add_rates(self, *, periodic: bool) -> None:
        car = self.vehicle
        rates = np.array([car.max_jerk, car.max_steering_rate])
        before = ca.DM([car.rolling_deceleration, 0.0])
        if periodic:
            before = self.inputs[:, -1]
        change = self.inputs - ca.horzcat(before, self.inputs[:, :-1])
        most = ca.DM(rates) @ self.steps
        unit = ca.diag(1.0 / SCALE[INPUT_COLUMN])
        self.require(unit @ (change - most), -np.inf, 0.0)
        self.require(unit @ (change + most), 0.0, np.inf)
        shares = ca.diag(1.0 / (rates * self._typical)) @ change
        self._roughness = SMOOTHNESS * ca.sumsqr(shares) / self.steps.shape[1]

    def require(self, expression: Any, low: Any, high: Any) -> None:
        """Bound an expression of the problem's symbols, of any shape, from both sides."""
        flat = ca.vec(expression)
        self._rows.append(
            (flat, np.broadcast_to(low, flat.shape[0]), np.broadcast_to(high, flat.shape[0]))
        )

    def solve(self, cost: Any, *, extra: float = 0.0, verbose: bool = False) -> Outcome:
        """Minimise a cost, an expression of the problem's symbols, from the guess.

        `extra` is the guess of that variable.
        """
        began = time.perf_counter()
        objective, rest = cost + self._roughness, ca.vertcat(*(row[0] for row in self._rows))
        n = self.steps.shape[1]
        ends = self._step.map(n)(self._stages)
        starts = ca.horzcat(self._stages[STATE_COLUMN, 1:], self._variables[-STATE_SIZE - 1 : -1])
        nlp = {
            "x": self._variables, "f": objective, "g": ca.vertcat(ca.vec(ends - starts), rest),
        }  # fmt: skip
        options: dict[str, Any] = {
            "print_time": False, "error_on_fail": False,
            **self._derivatives(objective, ca.vec(starts), rest),
            "ipopt": {
                "print_level": 5 if verbose else 0, "sb": "yes", "tol": TOLERANCE,
                "max_iter": ITERATIONS, "bound_relax_factor": 0.0,
            },
        }  # fmt: skip
        solver = ca.nlpsol("limit", "ipopt", nlp, options)
        exact = np.zeros(n * STATE_SIZE)
        found = solver(
            x0=np.append(self._packed(self.guess), extra),
            lbx=np.append(self._flat(self.lower), self.extra_range[0]),
            ubx=np.append(self._flat(self.upper), self.extra_range[1]),
            lbg=np.concatenate([exact, *(row[1] for row in self._rows)]),
            ubg=np.concatenate([exact, *(row[2] for row in self._rows)]),
        )
        stats = solver.stats()
        values = np.array(found["x"]).ravel()
        value = float(ca.Function("cost", [self._variables], [cost])(values))
        return Outcome(
            self._unpacked(values[:-1]), value, str(stats["return_status"]),
            int(stats["iter_count"]), time.perf_counter() - began,
        )  # fmt: skip

    def _derivatives(self, objective: ca.MX, starts: ca.MX, rest: ca.MX) -> dict[str, ca.Function]:
        """Return Jacobian and Hessian for IPOPT, that of the dynamics block by block.

        CasADi's own, by colouring of the whole, take four times as long.
        """
        w, n = self._variables, self.steps.shape[1]
        z, factor = ca.SX.sym("z", len(self._scale)), ca.SX.sym("factor", STATE_SIZE)
        end = self._step(z)
        slope = ca.Function("slope", [z], [ca.densify(ca.jacobian(end, z))])
        bend = ca.Function("bend", [z, factor], [ca.densify(ca.hessian(ca.dot(factor, end), z)[0])])

        def blocks(columns: ca.MX, more: int = 0) -> ca.MX:
            empty = ca.MX(more, STATE_SIZE + 1)
            return ca.diagcat(*ca.horzsplit(columns, len(self._scale)), empty)

        p, lam_f = ca.MX.sym("p", 0, 1), ca.MX.sym("lam_f")
        lam_g = ca.MX.sym("lam_g", n * STATE_SIZE + rest.shape[0])
        dynamics, others = lam_g[: n * STATE_SIZE], lam_g[n * STATE_SIZE :]
        jacobian = ca.vertcat(
            blocks(slope.map(n)(self._stages)) - ca.jacobian(starts, w), ca.jacobian(rest, w)
        )
        ends = self._step.map(n)(self._stages)
        values = ca.vertcat(ca.vec(ends) - starts, rest)
        stages = bend.map(n)(self._stages, ca.reshape(dynamics, STATE_SIZE, n))
        lagrangian = lam_f * objective + ca.dot(others, rest)
        hessian = blocks(stages, STATE_SIZE + 1) + ca.hessian(lagrangian, w)[0]
        return {
            "jac_g": ca.Function("jac_g", [w, p], [values, jacobian]),
            "hess_lag": ca.Function("hess_lag", [w, p, lam_f, lam_g], [ca.triu(hessian)]),
        }

    def _flat(self, rows: Array) -> Array:
        """Return rows of stages (n + 1, 9), the last without inputs, as scaled variables."""
        flat: Array = (rows / self._scale).ravel()
        return flat[: -(ACTION_SIZE + 1)]

    def _packed(self, motion: Motion) -> Array:
        inputs = np.column_stack([motion.inputs, motion.steps])
        return self._flat(np.column_stack([motion.state, np.vstack([inputs, inputs[-1:]])]))

    def _unpacked(self, values: Array) -> Motion:
        whole = np.concatenate([values, np.zeros(ACTION_SIZE + 1)])
        rows = whole.reshape(-1, len(self._scale)) * self._scale
        return Motion(rows[:-1, -1], rows[:, STATE_COLUMN], rows[:-1, INPUT_COLUMN])


def replay_steps(motion: Motion, vehicle: VehicleParameters) -> int:
    """Return the number of Runge-Kutta steps in each interval of a replay, none too long."""
    return math.ceil(float(motion.steps.max()) / longest_substep(vehicle) - 1e-9)


def replay(motion: Motion, vehicle: VehicleParameters, friction: float) -> Motion:
    """Return a motion with the same inputs from the same start, by the environment's integrator.

    Its steps, of the environment's length, are the intervals of the result.
    """
    return _driven(motion, vehicle, friction, np.zeros((len(motion.steps), 2, STATE_SIZE)))


def steadied_replay(motion: Motion, vehicle: VehicleParameters, friction: float) -> Motion:
    """Return what `replay` does, with a linear feedback of the distance from the motion.

    A vehicle at the limit is unstable: in open loop, rounding errors grow to decimetres over a lap.
    The gains are those of the linear-quadratic regulator about the motion; what they add to the
    inputs is the difference from the motion's.
    """
    integrate, count = _integrator(vehicle, friction), replay_steps(motion, vehicle)
    unit = np.concatenate([SCALE[STATE_COLUMN], SCALE[INPUT_COLUMN]])
    offsets = 1e-6 * np.diag(unit)
    cost = np.diag(1.0 / SCALE[STATE_COLUMN] ** 2)
    price = np.diag(1.0 / SCALE[INPUT_COLUMN] ** 2)
    gains = np.zeros((len(motion.steps), ACTION_SIZE, STATE_SIZE))
    to_go = cost
    for k in range(len(motion.steps) - 1, -1, -1):
        at, h = np.append(motion.state[k], motion.inputs[k]), motion.steps[k] / count

        def end(values: Array, h: float = h) -> Array:
            return integrate(values, h, count)

        slopes = [(end(at + d) - end(at - d)) / (2.0 * d.sum()) for d in offsets]
        a, b = np.array(slopes[:STATE_SIZE]).T, np.array(slopes[STATE_SIZE:]).T
        gains[k] = np.linalg.solve(price + b.T @ to_go @ b, b.T @ to_go @ a)
        to_go = cost + a.T @ to_go @ (a - b @ gains[k])
    return _driven(motion, vehicle, friction, gains)


def _driven(motion: Motion, vehicle: VehicleParameters, friction: float, gains: Array) -> Motion:
    """Return the motion that the integrator makes of inputs less gains times deviations."""
    integrate, count = _integrator(vehicle, friction), replay_steps(motion, vehicle)
    states, inputs = [motion.state[0]], []
    for k, step in enumerate(motion.steps):
        held = motion.inputs[k] - gains[k] @ (states[-1] - motion.state[k])
        for _ in range(count):
            inputs.append(held)
            states.append(integrate(np.append(states[-1], held), step / count, 1))
    return Motion(np.repeat(motion.steps / count, count), np.array(states), np.array(inputs))


def _integrator(
    vehicle: VehicleParameters, friction: float
) -> Callable[[Array, float, int], Array]:
    """Return the environment's integrator: state and inputs (8,), step in s, number of steps."""
    tyre, parameters = np.array(tyres.of(vehicle, friction)), vehicle.as_array()

    def integrated(at: Array, h: float, count: int) -> Array:
        after = np.empty(STATE_SIZE)
        _integrate(at, parameters, tyre, h, count, after)
        return after

    return integrated


@compiled
def _integrate(at: Array, p: Array, tyre: Array, h: float, count: int, after: Array) -> None:
    """Write the state (6,) that `count` steps of h seconds lead to, from state and inputs (8,)."""
    after[0], after[1], after[2], after[3], after[4], after[5] = integrate_with(
        at[0], at[1], at[2], at[3], at[4], at[5], at[6], at[7],
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], tyre, h, count,
    )  # fmt: skip
