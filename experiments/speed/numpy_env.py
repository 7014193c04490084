"""The vector environment written with NumPy: the comparison for the compiled kernels.

Model, substeps, projection, preview and reward are the same, as array operations over all
environments (the preview: over environments and nodes). The vector field is shared; none of the
project's compiled functions is used.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels as k
from lpv_track_env.bicycle import field, inverse_speed
from lpv_track_env.observation import PREVIEW_START
from lpv_track_env.task import Task
from trajectories.projection import SEARCH_WINDOW

Array = NDArray[np.float64]

NEWTON_STEPS = 4


class NumpyTracking:
    """Episodes of path tracking stepped in NumPy, without resets.

    Parameters
    ----------
    task
        The driving task of all episodes.
    records
        (n, `kernels.RECORD_SIZE`), as in a `PathTrackingVectorEnv`; copied.

    Attributes
    ----------
    state
        (6, n), in the order of `bicycle`.
    arc_length, lateral_error, heading_error, speed_error
        (n,) at the last step, m, m, rad, m/s.
    """

    def __init__(self, task: Task, records: Array) -> None:
        self.task = task
        path = task.path
        self._h, self._length, self._closed = path.spacing, path.length, path.closed
        self._x, self._y, self._heading = path.x, path.y, path.heading
        self._cos, self._sin = np.cos(path.heading), np.sin(path.heading)
        self._curvature, self._speed, self._time = path.curvature, path.speed, path.time
        self._cells = len(path.x) - 1
        self._turn = path.heading[-1] - path.heading[0]
        rows = records.T.copy()
        self.state = rows[:6]
        self._command = rows[[k.ACCELERATION, k.STEERING]]
        self.arc_length, self._start, self._steps = rows[k.ARC_LENGTH], rows[k.START], rows[k.STEPS]
        reach = math.ceil(SEARCH_WINDOW / self._h)
        self._window = np.arange(-reach, reach + 1)
        self._ahead = task.layout.preview_period * np.arange(1, task.layout.preview_steps + 1)
        self._bound = task.layout.bound

    def step(self, actions: Array) -> tuple[NDArray[np.float32], Array, Any, Any]:
        """Step with actions (n, 2); return observations, rewards, terminated, truncated."""
        last, before = self._command, self.arc_length
        self._command = self._actuate(actions.T)
        self.state = self._integrate(self.state, self._command)
        self._project()
        self._steps = self._steps + 1.0
        failed = (np.abs(self.lateral_error) > self.task.max_lateral_error) | (
            np.abs(self.heading_error) > k.MAX_HEADING_ERROR
        )
        goal = self._length + (self._start if self._closed else 0.0)
        terminated = failed | (self.arc_length >= goal - 1e-9)
        truncated = ~terminated & (self._steps >= self.task.max_steps)
        rewards = self._reward(self.arc_length - before, self._command - last, failed)
        return self._observe(), rewards, terminated, truncated

    def _actuate(self, commands: Array) -> Array:
        car, period = self.task.vehicle, self.task.control_period
        limit = np.array([[car.max_jerk], [car.max_steering_rate]]) * period
        low, high = car.acceleration_range
        angle = car.max_steering_angle
        ranged = np.clip(commands, [[low], [-angle]], [[high], [angle]])
        return np.clip(ranged, self._command - limit, self._command + limit)

    def _integrate(self, x: Array, command: Array) -> Array:
        a, delta = command
        cos_delta, sin_delta = np.cos(delta), np.sin(delta)
        parameters = self.task.vehicle.as_array()

        def derivative(x: Array) -> Array:
            vx, vy, psi, r, _, _ = x
            return np.array(
                field(
                    vx, vy, r, np.cos(psi), np.sin(psi), a, delta, cos_delta, sin_delta,
                    inverse_speed(vx), *parameters,
                )
            )  # fmt: skip

        h = self.task.control_period / self.task.substeps
        for _ in range(self.task.substeps):
            k1 = derivative(x)
            k2 = derivative(x + 0.5 * h * k1)
            k3 = derivative(x + 0.5 * h * k2)
            k4 = derivative(x + h * k3)
            x = x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return x

    def _cell(self, s: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return cell, fraction u within it, and completed laps, for arc lengths of any shape."""
        laps = np.floor(s / self._length) if self._closed else np.zeros_like(s)
        inside = np.clip(s - laps * self._length, 0.0, self._length)
        index = np.minimum((inside / self._h).astype(np.int64), self._cells - 1)
        return index, inside / self._h - index, laps

    def _cubic(self, values: Array, slopes: Array, index: Any, u: Array) -> tuple[Array, ...]:
        """Return value and first two derivatives (in u) of the Hermite cubic through the nodes."""
        a, b = values[index], values[index + 1]
        ma, mb = self._h * slopes[index], self._h * slopes[index + 1]
        c2, c3 = 3.0 * (b - a) - 2.0 * ma - mb, ma + mb - 2.0 * (b - a)
        return (
            a + u * (ma + u * (c2 + u * c3)),
            ma + u * (2.0 * c2 + 3.0 * u * c3),
            2.0 * c2 + 6.0 * u * c3,
        )

    def _project(self) -> None:
        vx, _, psi, _, x, y = self.state
        nodes = np.rint(self.arc_length / self._h).astype(np.int64)[:, None] + self._window
        wrapped = nodes % self._cells if self._closed else np.clip(nodes, 0, self._cells)
        squared = (x[:, None] - self._x[wrapped]) ** 2 + (y[:, None] - self._y[wrapped]) ** 2
        nearest = squared.argmin(axis=1)[:, None]
        node = np.take_along_axis(nodes if self._closed else wrapped, nearest, axis=1)[:, 0]
        s = node * self._h
        low, high = s - self._h, s + self._h
        if not self._closed:
            low, high = np.maximum(low, 0.0), np.minimum(high, self._length)
        for _ in range(NEWTON_STEPS):
            index, u, _ = self._cell(s)
            px, tx, bx = self._cubic(self._x, self._cos, index, u)
            py, ty, by = self._cubic(self._y, self._sin, index, u)
            dx, dy = x - px, y - py
            stretch = np.maximum(tx * tx + ty * ty - dx * bx - dy * by, 0.3 * self._h**2)
            s = np.clip(s + self._h * (dx * tx + dy * ty) / stretch, low, high)
        index, u, laps = self._cell(s)
        px, tx, _ = self._cubic(self._x, self._cos, index, u)
        py, ty, _ = self._cubic(self._y, self._sin, index, u)
        self.arc_length = s
        self.lateral_error = ((y - py) * tx - (x - px) * ty) / np.hypot(tx, ty)
        heading = self._cubic(self._heading, self._curvature, index, u)[0] + laps * self._turn
        error = psi - heading
        self.heading_error = error - 2.0 * np.pi * np.ceil((error - np.pi) / (2.0 * np.pi))
        self.reference_speed = self._speed_at(index, u)
        self.speed_error = vx - self.reference_speed

    def _speed_at(self, index: Any, u: Array) -> Array:
        speeds: Array = np.sqrt(
            (1.0 - u) * self._speed[index] ** 2 + u * self._speed[index + 1] ** 2
        )
        return speeds

    def _reward(self, progress: Array, change: Array, failed: NDArray[np.bool_]) -> Array:
        w, period = self.task.reward_weights, self.task.control_period

        def rho(z: Array) -> Array:
            return np.sqrt(1.0 + z * z) - 1.0

        jerk, steering_rate = change / period
        rewards: Array = (
            w.progress * progress / np.maximum(self.reference_speed, 0.1)
            - w.lateral * period * rho(self.lateral_error / w.lateral_scale)
            - w.heading * period * rho(self.heading_error / w.heading_scale)
            - w.speed * period * rho(self.speed_error / w.speed_scale)
            - w.input_rate
            * period
            * ((jerk / w.jerk_scale) ** 2 + (steering_rate / w.steering_rate_scale) ** 2)
            - w.end * failed
        )
        return rewards

    def _observe(self) -> NDArray[np.float32]:
        first, count = PREVIEW_START, self.task.layout.preview_steps
        values = np.empty((len(self.arc_length), len(self._bound)))
        vx, vy, _, r, _, _ = self.state
        scalars = (vx, vy, r, *self._command, self.lateral_error, self.heading_error)
        for column, scalar in enumerate((*scalars, self.reference_speed)):
            values[:, column] = scalar
        curvature, speed = self._preview()
        values[:, first : first + count] = curvature
        values[:, first + count :] = speed
        return np.clip(values, -self._bound, self._bound).astype(np.float32)

    def _preview(self) -> tuple[Array, Array]:
        """Return mean curvature before, and speed at, the next K nodes in time, (n, K) each."""
        index, u, laps = self._cell(self.arc_length)
        speed = self._speed_at(index, u)
        now = self._time[index] + 2.0 * u * self._h / (self._speed[index] + speed)
        duration = self._time[-1]
        times = now[:, None] + self._ahead
        beyond = np.zeros_like(times)
        ahead = laps[:, None]
        if self._closed:
            more = np.floor(times / duration)
            times = times - more * duration
            ahead = ahead + more
        else:
            beyond = np.maximum(times - duration, 0.0)
            times = np.minimum(times, duration)
        cells = np.minimum(np.searchsorted(self._time, times, "right") - 1, self._cells - 1)
        v0, v1 = self._speed[cells], self._speed[cells + 1]
        tau = times - self._time[cells]
        half = 0.25 * (v1 * v1 - v0 * v0) / self._h * tau
        offset = np.minimum(tau * (v0 + half), self._h)
        ends = ahead * self._length + cells * self._h + offset + beyond * self._speed[-1]
        headings = self._cubic(self._heading, self._curvature, cells, offset / self._h)[0]
        headings += ahead * self._turn
        start = self._cubic(self._heading, self._curvature, index, u)[0] + laps * self._turn
        turned = np.diff(headings, axis=1, prepend=start[:, None])
        lengths = np.diff(ends, axis=1, prepend=self.arc_length[:, None])
        return turned / np.maximum(lengths, 1e-9), v0 + 2.0 * half
