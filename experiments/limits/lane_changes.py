"""Highest entry speed at which a vehicle can pass the cones of a lane change."""

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiments.limits.optimal_control import ControlProblem, Motion, Outcome, replay
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.vehicle import VehicleParameters
from trajectories import ReferencePath
from trajectories.lane_changes import clearance, outline

Array = NDArray[np.float64]

SPACING = 0.5
"""m between nodes along x."""
PLAY = 3e-3
"""Distance from the cones that is kept at the nodes, m; so none is touched between them."""
ROUNDS = 6
"""Most solves, each with the constraints that the headings of the last one call for."""
SETTLED = 1e-4
"""m by which a solution may miss the distance that it found, if it calls for other constraints."""
END_SLIP, END_YAW_RATE = 0.1, 0.2
"""Largest |vy| / vx and yaw rate (rad/s) after the last cones: a motion that can go on."""


def corners_of(vehicle: VehicleParameters) -> Array:
    """Return the corners of a vehicle's body about its centre of gravity, (4, 2) m."""
    middle = 0.5 * (vehicle.front_axle_distance - vehicle.rear_axle_distance)
    return outline(vehicle.length, vehicle.width, middle)


def along_the_line(path: ReferencePath, vehicle: VehicleParameters, speed: float) -> Motion:
    """Return a first guess: along the path's line at a constant speed, steady turns everywhere."""
    end = path.metadata["cones"][-1][1] - corners_of(vehicle)[:, 0].min() + 1.0
    x = np.linspace(0.0, end, round(end / SPACING) + 1)
    s = np.interp(x, path.x, path.arc_length)
    at = path.sample(s)
    state = np.zeros((len(x), 6))
    state[:, VX], state[:, PSI], state[:, YAW_RATE] = speed, at.heading, speed * at.curvature
    state[:, X], state[:, Y] = x, at.y
    steering = (vehicle.wheelbase + vehicle.understeer_gradient * speed**2) * at.curvature[:-1]
    held = np.full_like(steering, vehicle.rolling_deceleration)
    return Motion(np.diff(s) / speed, state, np.column_stack([held, steering]))


def highest_entry_speed(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, kept: float, guess: Motion
) -> Outcome:
    """Maximise the entry speed; the outcome's value is minus that speed, m/s.

    The vehicle keeps at least the share `kept` of it.
    """
    for _ in range(ROUNDS):
        problem = _between_cones(path, vehicle, friction, guess, kept)
        outcome = problem.solve(-problem.states[VX, 0])
        kept = measured(path, vehicle, outcome.motion) > PLAY - SETTLED
        if kept or not outcome.solved:
            break
        guess = outcome.motion
    return outcome


def widest(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, kept: float, speed: float,
    guess: Motion,
) -> Outcome:  # fmt: skip
    """Maximise the distance from the cones at an entry speed (m/s).

    The outcome's value is minus the distance beyond `PLAY`, m.
    """
    for _ in range(ROUNDS):
        problem = _between_cones(path, vehicle, friction, guess, kept)
        problem.lower[0, VX] = problem.upper[0, VX] = speed
        problem.extra_range = (-np.inf, np.inf)
        outcome = problem.solve(-problem.extra, extra=-1.0)
        distance = PLAY - outcome.value
        kept = measured(path, vehicle, outcome.motion) > distance - SETTLED
        if kept or not outcome.solved:
            break
        guess = outcome.motion
    return outcome


def measured(path: ReferencePath, vehicle: VehicleParameters, motion: Motion) -> float:
    """Return the clearance of a motion's states from the path's cones, m."""
    state = motion.state
    return clearance(
        path.metadata["cones"], state[:, X], state[:, Y], state[:, PSI], corners_of(vehicle)
    )


def replayed_clearance(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, motion: Motion
) -> float:
    """Return the clearance of a motion's inputs, driven anew by the environment's integrator, m."""
    return measured(path, vehicle, replay(motion, vehicle, friction))


def _between_cones(
    path: ReferencePath, vehicle: VehicleParameters, friction: float, guess: Motion, kept: float
) -> ControlProblem:
    """Return the problem; its extra variable is the distance beyond `PLAY` from the cones."""
    problem = ControlProblem(vehicle, friction, guess, periodic=False)
    problem.lower[:, X] = problem.upper[:, X] = guess.state[:, X]
    problem.lower[:, PSI], problem.upper[:, PSI] = -1.0, 1.0
    start = [VY, PSI, YAW_RATE, Y]
    problem.lower[0, start] = problem.upper[0, start] = 0.0
    problem.lower[-1, YAW_RATE], problem.upper[-1, YAW_RATE] = -END_YAW_RATE, END_YAW_RATE
    slip = problem.states[VY, -1] / problem.states[VX, -1]
    problem.require(slip, -END_SLIP, END_SLIP)
    speeds = problem.states[VX, :]
    if kept > 0.0:
        problem.require(speeds[1:] - kept * speeds[0], 0.0, np.inf)
    x, y, psi = (problem.states[k, :].T for k in (X, Y, PSI))
    c, s, half = ca.cos(psi), ca.sin(psi), 0.5 * vehicle.width
    corners, crossings, cones = _places(path.metadata["cones"], guess.state, corners_of(vehicle))

    def corner(node: Array, d: Array, e: Array) -> tuple[ca.MX, ca.MX]:
        k = node.astype(int).tolist()
        return x[k] + d * c[k] - e * s[k], y[k] + d * s[k] + e * c[k]

    _, inside = corner(*corners[:3])
    node, d, e, end = crossings[:4]
    (x0, y0), (x1, y1) = corner(node, d, e), corner(node + 1, d, e)
    passing = y0 + (end - x0) / (x1 - x0) * (y1 - y0)
    for across, (right, left) in ((inside, corners[-2:]), (passing, crossings[-2:])):
        problem.require(ca.vertcat(left - across, across - right) - problem.extra, PLAY, np.inf)
    k = cones[0].astype(int).tolist()
    for side, line in ((-1.0, cones[-2]), (1.0, cones[-1])):
        flank = y[k] + ((cones[1] - x[k]) * s[k] + side * half) / c[k]
        problem.require(side * (line - flank) - problem.extra, PLAY, np.inf)
    return problem


def _places(cones: list[list[float]], state: Array, corners: Array) -> tuple[Array, Array, Array]:
    """Return where the body is beside a lane, in columns; the last two are y_right and y_left.

    - node, d, e: a corner of the body (d, e) is between the ends of the lane at a node.
    - node, d, e, x: a corner passes an end of the lane, x, between a node and the next.
    - node, x: the cones at an end of the lane are beside the body at a node.
    """
    c, s = np.cos(state[:, PSI]), np.sin(state[:, PSI])
    front, rear = corners[:, 0].max(), corners[:, 0].min()
    inside, passing, beside = [], [], []
    for begin, last, *sides in cones:
        for d, e in corners.tolist():
            along = state[:, X] + d * c - e * s
            between = np.flatnonzero((along >= begin) & (along <= last))
            inside += [(k, d, e, *sides) for k in between.tolist()]
            for end in (begin, last):
                crossed = np.flatnonzero((along[:-1] < end) & (along[1:] > end))
                passing += [(k, d, e, end, *sides) for k in crossed.tolist()]
        for end in (begin, last):
            ahead = (end - state[:, X]) * c
            between = np.flatnonzero((ahead > rear) & (ahead < front))
            beside += [(k, end, *sides) for k in between.tolist()]
    return np.array(inside).T, np.array(passing).T, np.array(beside).T
