"""Least time of a flying lap of a closed path within a corridor."""

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiments.limits.optimal_control import (
    ControlProblem,
    Motion,
    Outcome,
    replay_steps,
    steadied_replay,
)
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.smoothing import chord_lengths

Array = NDArray[np.float64]

PERIOD = 0.06
"""s between nodes at the speeds of the guess: about a control period."""
GUESS_GRIP = 0.75
"""Share of the friction that the first guess uses."""
INSIDE = 5e-3
"""m by which the nodes keep within the corridor; so the motion does between them."""


CORRECTION = 1e-4
"""Most that a replay's feedback may change the inputs, m/s^2 and rad."""


def quasi_static(path: ReferencePath, vehicle: VehicleParameters, friction: float) -> Motion:
    """Return a first guess: along the path, at speeds within a share of the friction circle.

    Speeds come from a forward and a backward pass over two laps, states and inputs from steady
    turns. Nodes are `PERIOD` apart in time.
    """
    grip = GUESS_GRIP * friction * GRAVITY
    low, high = vehicle.acceleration_range
    curvature, h = np.abs(path.curvature[:-1]), path.spacing
    squared = np.minimum(grip / np.maximum(curvature, 1e-6), vehicle.speed_range[1] ** 2)
    laps, bent = np.tile(squared, 3), np.tile(curvature, 3)
    for order, most in ((1, 0.8 * high), (-1, -0.8 * low)):
        laps, bent = laps[::order].copy(), bent[::order]
        for k in range(1, len(laps)):
            left = max(grip**2 - (bent[k - 1] * laps[k - 1]) ** 2, 0.0) ** 0.5
            laps[k] = min(laps[k], laps[k - 1] + 2.0 * h * min(most, left))
        laps, bent = laps[::order], bent[::order]
    speed = np.append(np.sqrt(laps[len(squared) : 2 * len(squared)]), 0.0)
    speed[-1] = speed[0]
    clock = np.concatenate([[0.0], np.cumsum(2.0 * h / (speed[1:] + speed[:-1]))])
    count = math.ceil(clock[-1] / PERIOD)
    time = np.linspace(0.0, clock[-1], count + 1)
    s = np.interp(time, clock, path.arc_length)
    at, v = path.sample(s), np.interp(s, path.arc_length, speed)
    state = np.zeros((count + 1, 6))
    heading = np.interp(s, path.arc_length, path.heading)
    state[:, VX], state[:, PSI], state[:, YAW_RATE] = v, heading, v * at.curvature
    state[:, X], state[:, Y] = at.x, at.y
    bend = (vehicle.wheelbase + vehicle.understeer_gradient * v**2) * at.curvature
    steering = bend.clip(-0.9 * vehicle.max_steering_angle, 0.9 * vehicle.max_steering_angle)
    accelerations = np.diff(v**2) / (2.0 * np.diff(s)) + vehicle.rolling_deceleration
    return Motion(np.diff(time), state, np.column_stack([accelerations, steering[:-1]]))


def least_lap_time(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, corridor: float,
    guess: Motion, *, verbose: bool = False,
) -> Outcome:  # fmt: skip
    """Minimise the time of a flying lap; the outcome's value is that time, s.

    The centre of gravity stays within `corridor` (m) of the path, at no more than the vehicle's top
    speed; state and inputs at the lap's end are those at its start.
    """
    problem = _lap(path, vehicle, friction, guess, corridor)
    return problem.solve(ca.sum2(problem.steps), verbose=verbose)


def narrowest(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, lap_time: float,
    guess: Motion,
) -> Outcome:  # fmt: skip
    """Minimise the corridor in which a lap of a given time (s) is possible; the value is in m."""
    problem = _lap(path, vehicle, friction, guess, None)
    problem.require(ca.sum2(problem.steps), -np.inf, lap_time)
    problem.extra_range = (0.0, np.inf)
    return problem.solve(problem.extra, extra=1.0)


def largest_error(path: ReferencePath, motion: Motion) -> float:
    """Return the largest distance of a motion's states from the path, m."""
    s, errors = 0.0, []
    for x, y in motion.state[:, [X, Y]].tolist():
        foot = path.project(x, y, s)
        s = foot.arc_length
        errors.append(abs(foot.lateral_error))
    return max(errors)


def replayed_error(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, motion: Motion
) -> float:
    """Return `largest_error` of a motion driven anew by the environment's integrator, m.

    Raises
    ------
    RuntimeError
        If the feedback that keeps it steady changes an input by more than `CORRECTION`.
    """
    again = steadied_replay(motion, vehicle, friction)
    change = np.abs(again.inputs[:: replay_steps(motion, vehicle)] - motion.inputs).max()
    if change > CORRECTION:
        raise RuntimeError(f"path {path.name}: a replay needs corrections of {change:.2g}")
    return largest_error(path, again)


def _lap(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, guess: Motion,
    corridor: float | None,
) -> ControlProblem:  # fmt: skip
    """Return the problem; without a corridor its half width is the problem's extra variable."""
    if not path.closed:
        raise ValueError(f"path {path.name}: a flying lap needs a closed path")
    problem = ControlProblem(vehicle, friction, guess, periodic=True)
    problem.upper[:, VX] = vehicle.speed_range[1]
    problem.lower[:, VY], problem.upper[:, VY] = -10.0, 10.0
    # Nodes lie on the normals of the path at the guess's feet.
    feet = np.array([path.project(x, y, s).arc_length for x, y, s in _places(path, guess)])
    at = path.sample(feet)
    c, s = np.cos(at.heading), np.sin(at.heading)
    ahead, aside = (problem.states[k, :].T for k in (X, Y))
    ahead, aside = ahead - at.x, aside - at.y
    problem.require(c * ahead + s * aside, 0.0, 0.0)
    error = c * aside - s * ahead
    if corridor is None:
        problem.require(ca.vertcat(problem.extra - error, problem.extra + error), INSIDE, np.inf)
    else:
        problem.require(error, INSIDE - corridor, corridor - INSIDE)
    turned = path.heading[-1] - path.heading[0]
    ends = problem.states[:, -1] - problem.states[:, 0]
    across = np.array([0.0, 0.0, turned, 0.0])
    problem.require(ends[[VX, VY, PSI, YAW_RATE]] - across, 0.0, 0.0)
    # Both ends lie on one normal: one equation more makes them one point.
    problem.require(error[-1] - error[0], 0.0, 0.0)
    return problem


def _places(path: ReferencePath, motion: Motion) -> list[tuple[float, float, float]]:
    """Return the positions of a motion, and about how far along the path they are."""
    shares = chord_lengths(motion.state[:, [X, Y]])
    along = path.length * shares / shares[-1]
    along[-1] = path.length - 1e-9
    return [(x, y, s) for (x, y), s in zip(motion.state[:, [X, Y]].tolist(), along, strict=True)]
