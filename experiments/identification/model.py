"""The model that is fitted: actuators with dead time and lag, then the project's vector field.

Motion is predicted in windows of some seconds, with initial states of their own, so that errors
do not grow over the whole log. The field is `bicycle.casadi_derivative` per unit of mass,
integrated by classic Runge-Kutta steps from reading to reading; its sensitivities are exact.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiments.identification.log import Log
from lpv_track_env.bicycle import STATE_SIZE, casadi_derivative
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]

PARAMETERS = (
    "front_stiffness", "rear_stiffness", "inertia_ratio", "rolling_deceleration", "drive_gain",
    "steering_offset", "yaw_rate_bias", "sideslip_offset", "drive_lag", "drive_dead_time",
    "steering_lag", "steering_dead_time",
)  # fmt: skip
"""Parameters of the model: stiffnesses per mass, N/(rad kg); Iz/(m lf lr); deceleration, m/s^2;
acceleration by its command; rad; rad/s; rad, by which the sensors' axis points to the right of the
vehicle's; the rest s."""
(
    FRONT, REAR, RATIO, ROLLING, GAIN, OFFSET, BIAS, SIDESLIP, DRIVE_LAG, DRIVE_DEAD, STEERING_LAG,
    STEERING_DEAD,
) = range(len(PARAMETERS))  # fmt: skip
COUNT = len(PARAMETERS)
SCALED = (FRONT, REAR, RATIO, GAIN)
"""Parameters whose logarithm is fitted; their deviations are relative."""
UNITS: Mapping[int, str] = {
    FRONT: "N/(rad kg)", REAR: "N/(rad kg)", RATIO: "", ROLLING: "m/s^2", GAIN: "", OFFSET: "rad",
    BIAS: "rad/s", SIDESLIP: "rad", DRIVE_LAG: "s", DRIVE_DEAD: "s", STEERING_LAG: "s",
    STEERING_DEAD: "s",
}  # fmt: skip
SHORTEST_LAG, LONGEST_LAG, LONGEST_DEAD = 1e-6, 1.0, 1.0
"""Bounds of lags and dead times, s; the shortest lag counts as none."""
LOWER, UPPER = np.full(COUNT, -np.inf), np.full(COUNT, np.inf)
LOWER[[DRIVE_LAG, STEERING_LAG]], UPPER[[DRIVE_LAG, STEERING_LAG]] = SHORTEST_LAG, LONGEST_LAG
LOWER[[DRIVE_DEAD, STEERING_DEAD]], UPPER[[DRIVE_DEAD, STEERING_DEAD]] = 0.0, LONGEST_DEAD
BLOCK = STATE_SIZE + COUNT
"""Columns of a window's sensitivities: initial state, then parameters."""


def nominal_parameters(vehicle: VehicleParameters) -> Array:
    """Return the parameters (`COUNT`,) of a vehicle with perfect actuators and sensors."""
    values = np.zeros(COUNT)
    values[FRONT] = vehicle.front_cornering_stiffness / vehicle.mass
    values[REAR] = vehicle.rear_cornering_stiffness / vehicle.mass
    arms = vehicle.front_axle_distance * vehicle.rear_axle_distance
    values[RATIO] = vehicle.yaw_inertia / (vehicle.mass * arms)
    values[ROLLING], values[GAIN] = vehicle.rolling_deceleration, 1.0
    values[[DRIVE_LAG, STEERING_LAG]] = SHORTEST_LAG
    return values


@dataclass(frozen=True)
class _PerMass:
    """Stand-in for the `VehicleParameters` of a mass of 1 kg, with CasADi symbols for numbers."""

    lf: float
    lr: float
    centre_of_gravity_height: float
    symbols: Any

    def as_array(self) -> tuple[Any, ...]:
        front, rear, ratio, rolling = ca.vertsplit(self.symbols)
        return 1.0, ratio * (self.lf * self.lr), self.lf, self.lr, front, rear, rolling


class Windows(NamedTuple):
    """Windows of a log as arrays of (windows, steps), padded with steps of no length."""

    nodes: Array
    """(N + 1,) s, times between which the actuators are computed."""
    first: NDArray[np.int64]
    """(W,), index in `nodes` of each window's start."""
    steps: NDArray[np.int64]
    """(W,), number of steps of each window."""
    readings: tuple[dict[str, tuple[NDArray[np.int64], Array]], ...]
    """For each window and channel: steps after which it was read, and the values."""

    @property
    def lengths(self) -> Array:
        """(N,) s, lengths of the steps."""
        return np.diff(self.nodes)


def windows_of(log: Log, begin: float, end: float, length: float, longest_step: float) -> Windows:
    """Cut what was logged between two times into windows of about `length` seconds."""
    read = np.unique(np.concatenate([np.round(times, 6) for times, _ in log.readings.values()]))
    read = read[(read >= begin - 1e-9) & (read <= end + 1e-9)]
    count = max(int((read[-1] - read[0]) / length + 0.5), 1)
    borders = np.unique(np.searchsorted(read, np.linspace(read[0], read[-1], count + 1) - 1e-9))
    nodes = [read[:1]]
    for before, after in itertools.pairwise(read):
        pieces = max(int(np.ceil((after - before) / longest_step - 1e-9)), 1)
        nodes.append(before + (after - before) * np.arange(1, pieces + 1) / pieces)
    grid = np.concatenate(nodes)
    starts = np.searchsorted(grid, read[borders] - 1e-9)
    chosen = []
    for a, b in itertools.pairwise(starts):
        seen = {}
        for name, (times, values) in log.readings.items():
            at = np.searchsorted(grid, np.round(times, 6) - 1e-7)
            inside = (times >= grid[a] - 1e-7) & (times <= grid[b] + 1e-7)
            seen[name] = (at[inside] - a, values[inside])
        chosen.append(seen)
    return Windows(grid, starts[:-1], np.diff(starts), tuple(chosen))


class Actuators:
    """Outputs of the actuators, averaged over the steps of a grid, with their derivatives.

    As in `conditions.vehicle`: a command counts from its time plus the dead time on, a first-order
    lag follows. Steps within which the command changes count with its mean.
    """

    def __init__(self, log: Log, nodes: Array) -> None:
        self._times, self._commands = log.commands
        self._nodes, self._lengths = nodes, np.diff(nodes)
        steps = np.diff(self._times)[:, None] * self._commands[:-1]
        self._integral = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        held, lag, length, wanted = (ca.SX.sym(name) for name in ("s", "lag", "h", "w"))
        kept = ca.exp(-length / lag)
        mean = wanted + (held - wanted) * (1.0 - kept) * lag / length
        after = wanted + (held - wanted) * kept
        # Sensitivities to the lag and to the wanted value, whose own derivative is `slope`.
        by_lag, by_dead, slope = (ca.SX.sym(name) for name in ("sl", "sd", "wd"))

        def along(of: Any, change: Any, lagged: float, slope: Any) -> Any:
            return (
                ca.jacobian(of, held) * change + ca.jacobian(of, lag) * lagged
                + ca.jacobian(of, wanted) * slope
            )  # fmt: skip

        state = ca.vertcat(held, by_lag, by_dead)
        following = ca.vertcat(
            after, along(after, by_lag, 1.0, 0.0), along(after, by_dead, 0.0, slope)
        )
        out = ca.vertcat(mean, along(mean, by_lag, 1.0, 0.0), along(mean, by_dead, 0.0, slope))
        given = ca.vertcat(lag, length, wanted, slope)
        step = ca.Function("servo", [state, given], [following, out])
        self._all = step.mapaccum("servos", len(self._lengths))

    def _before(self, times: Array, column: int) -> tuple[Array, Array]:
        """Return the integral of a command up to times, and the command in force just before."""
        at = np.clip(np.searchsorted(self._times, times, side="left") - 1, 0, None)
        value = self._commands[at, column]
        return self._integral[at, column] + (times - self._times[at]) * value, value

    def outputs(self, column: int, lag: float, dead: float) -> Array:
        """Return the mean output and its derivatives by lag and dead time, (3, N)."""
        integral, value = self._before(self._nodes - dead, column)
        wanted = np.diff(integral) / self._lengths
        slope = -np.diff(value) / self._lengths
        given = np.vstack(
            [np.full_like(wanted, max(lag, SHORTEST_LAG)), self._lengths, wanted, slope]
        )
        out: Array = self._all(np.array([wanted[0], 0.0, 0.0]), given)[1].full()
        return out


class Predictor:
    """Predictions of a set of windows, with sensitivities.

    Parameters
    ----------
    vehicle
        The nominal vehicle: its axles' places, and the height of the centre of gravity.
    parts
        Windows with their logs.
    friction
        Coefficient of friction of the tyres; inf makes them linear.
    """

    def __init__(
        self, vehicle: VehicleParameters, parts: Sequence[tuple[Log, Windows]], friction: float
    ) -> None:
        self._parts = [(windows, Actuators(log, windows.nodes)) for log, windows in parts]
        self.windows = [one for windows, _ in self._parts for one in windows.readings]
        self.longest = max(int(windows.steps.max()) for windows, _ in self._parts)
        self._map = _window(vehicle, friction).mapaccum("window", self.longest)

    def _gathered(self, series: Sequence[Array]) -> Array:
        """Return rows of the logs' series (N, ...) window by window, zeros behind their ends."""
        out = np.zeros((len(self.windows), self.longest, *series[0].shape[1:]))
        row = 0
        for (windows, _), values in zip(self._parts, series, strict=True):
            for a, n in zip(windows.first, windows.steps, strict=True):
                out[row, :n] = values[a : a + n]
                row += 1
        return out

    def predict(self, initial: Array, parameters: Array) -> tuple[Array, Array]:
        """Return states (W, K + 1, 6) and their derivatives (W, K + 1, `BLOCK`, 6).

        `initial` (W, 6) are the states at the windows' starts, `parameters` as in `PARAMETERS`.
        """
        p = parameters
        inputs, slopes = [], []
        for windows, actuators in self._parts:
            a, a_lag, a_dead = actuators.outputs(0, p[DRIVE_LAG], p[DRIVE_DEAD])
            d, d_lag, d_dead = actuators.outputs(1, p[STEERING_LAG], p[STEERING_DEAD])
            given = np.empty((len(a), 7))
            given[:, 0], given[:, 1], given[:, 2] = p[GAIN] * a, d + p[OFFSET], windows.lengths
            inputs.append(given)
            by = np.zeros((len(a), COUNT, 2))
            by[:, GAIN, 0] = a
            by[:, DRIVE_LAG, 0], by[:, DRIVE_DEAD, 0] = p[GAIN] * a_lag, p[GAIN] * a_dead
            by[:, OFFSET, 1] = 1.0
            by[:, STEERING_LAG, 1], by[:, STEERING_DEAD, 1] = d_lag, d_dead
            slopes.append(by)
        given, by = self._gathered(inputs), self._gathered(slopes)
        given[:, :, 3:] = p[[FRONT, REAR, RATIO, ROLLING]]
        count = len(self.windows)
        found = np.zeros((count, self.longest + 1, 1 + BLOCK, STATE_SIZE))
        found[:, 0, 0] = initial
        found[:, 0, 1 : 1 + STATE_SIZE] = np.eye(STATE_SIZE)
        # CasADi's matrices lie in memory column by column: as these arrays do.
        buffer, evaluate = self._map.buffer()
        for row in range(count):
            for place, array in enumerate((found[row, 0], given[row], by[row])):
                buffer.set_arg(place, array.ravel().data)
            buffer.set_res(0, found[row, 1:].reshape(-1).data)
            evaluate()
        return found[:, :, 0], found[:, :, 1:]


def _window(vehicle: VehicleParameters, friction: float) -> Any:
    """Return one Runge-Kutta step of state and sensitivities as a CasADi function.

    Arguments: [x, S] (6, 1 + `BLOCK`); [a, delta, h, p] (7,); d(a, delta)/d parameters (2, COUNT).
    """
    x, given = ca.SX.sym("x", STATE_SIZE), ca.SX.sym("given", 7)
    u, h, physical = given[:2], given[2], given[3:]
    car: Any = _PerMass(
        vehicle.front_axle_distance, vehicle.rear_axle_distance, vehicle.centre_of_gravity_height,
        physical,
    )  # fmt: skip
    k1 = casadi_derivative(x, u, car, friction)
    k2 = casadi_derivative(x + 0.5 * h * k1, u, car, friction)
    k3 = casadi_derivative(x + 0.5 * h * k2, u, car, friction)
    k4 = casadi_derivative(x + h * k3, u, car, friction)
    after = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    one = ca.Function(
        "one", [x, given],
        [after, ca.jacobian(after, x), ca.jacobian(after, u), ca.jacobian(after, physical)],
        {"cse": True},
    )  # fmt: skip
    both = ca.SX.sym("both", STATE_SIZE, 1 + BLOCK)
    moved = ca.SX.sym("moved", 2, COUNT)
    following, by_state, by_input, by_physical = one(both[:, 0], given)
    direct = ca.SX(STATE_SIZE, BLOCK)
    direct[:, STATE_SIZE:] = by_input @ moved
    for column, place in enumerate((FRONT, REAR, RATIO, ROLLING)):
        direct[:, STATE_SIZE + place] += by_physical[:, column]
    sensitivities = by_state @ both[:, 1:] + direct
    return ca.Function(
        "step", [both, given, moved], [ca.horzcat(following, sensitivities)], {"cse": True}
    )
