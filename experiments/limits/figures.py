"""Draws the motion at a limit: plan with cones or corridor, speed, steering, acceleration."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import trajectories
from experiments.figures import COLOURS, save_figure
from experiments.limits.compute import Found
from experiments.limits.lane_changes import corners_of
from experiments.limits.optimal_control import Motion
from lpv_track_env import vehicle
from lpv_track_env.bicycle import PSI, VX, VY, X, Y
from lpv_track_env.plausibility import GRAVITY
from trajectories import ReferencePath

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BODIES = 14
"""Outlines of the body along a lane change."""


def draw(found: Found, file: Path) -> None:
    """Draw a limit's motion; the file's suffix chooses the format."""
    from matplotlib.figure import Figure

    limit, motion = found
    case = limit.case
    path, car = trajectories.load(case.path), vehicle.load(case.vehicle)
    cones = path.metadata.get("cones")
    unit = "m/s" if limit.kind == "entry speed" else "s"
    figure = Figure(figsize=(11.0, 8.0 if cones else 10.0), layout="constrained")
    tall = 1.4 if cones else 3.5
    grid = figure.add_gridspec(4, 1, height_ratios=(tall, 1.0, 1.0, 1.0))
    plan = figure.add_subplot(grid[0])
    if cones:
        _lane_change(plan, motion, cones, corners_of(car))
    else:
        _circuit(plan, path, motion, case.corridor)
    plan.set_title(
        f"{case.path}, {case.vehicle}, friction {case.friction:g}: {limit.kind} {limit.value:.3f} "
        f"{unit}"
    )
    along = motion.state[:, X] if cones else _travelled(motion)
    speed, steering, grip = (figure.add_subplot(grid[k]) for k in (1, 2, 3))
    speed.plot(along, motion.state[:, VX], color=COLOURS[0])
    speed.set_ylabel("vx (m/s)")
    command, angle = (np.append(values, values[-1]) for values in motion.inputs.T)
    steering.step(along, angle, where="post", color=COLOURS[1], label="steering")
    slip = np.arctan2(motion.state[:, VY], motion.state[:, VX])
    steering.plot(along, slip, color=COLOURS[2], label="sideslip")
    steering.set_ylabel("angle (rad)")
    steering.legend(loc="upper right")
    across = np.gradient(motion.state[:, VY], motion.time)
    across += motion.state[:, VX] * motion.state[:, 3]
    grip.step(along, command, where="post", color=COLOURS[3], label="a, command")
    grip.plot(along, across, color=COLOURS[4], label="lateral")
    for sign in (-1.0, 1.0):
        grip.axhline(sign * case.friction * GRAVITY, color="0.6", linewidth=0.7)
    grip.set_ylabel("acceleration (m/s²)")
    grip.set_xlabel("x (m)" if cones else "distance (m)")
    grip.legend(loc="upper right")
    for axes in (speed, steering, grip):
        axes.set_xlim(along[0], along[-1])
        axes.grid(alpha=0.3)
    save_figure(figure, file)


def _lane_change(
    axes: "Axes", motion: Motion, cones: list[list[float]], corners: np.ndarray
) -> None:
    for begin, end, right, left in cones:
        for line in (right, left):
            axes.plot((begin, end), (line, line), color=COLOURS[1], linewidth=1.5)
    state = motion.state
    axes.plot(state[:, X], state[:, Y], color=COLOURS[0])
    around = np.vstack([corners, corners[:1]])
    for k in np.linspace(0, len(state) - 1, BODIES).round().astype(int).tolist():
        c, s = np.cos(state[k, PSI]), np.sin(state[k, PSI])
        axes.plot(
            state[k, X] + around @ (c, -s), state[k, Y] + around @ (s, c),
            color="0.35", linewidth=0.7,
        )  # fmt: skip
    axes.set_ylabel("y (m), enlarged")
    axes.set_xlim(state[0, X], state[-1, X])
    axes.grid(alpha=0.3)


def _circuit(axes: "Axes", path: ReferencePath, motion: Motion, corridor: float) -> None:
    from matplotlib.collections import LineCollection

    for side in (-corridor, corridor):
        axes.plot(
            path.x - side * np.sin(path.heading), path.y + side * np.cos(path.heading),
            color="0.6", linewidth=0.6,
        )  # fmt: skip
    points = motion.state[:, [X, Y]]
    lines = LineCollection([*np.stack([points[:-1], points[1:]], axis=1)], linewidth=2.0)
    lines.set_array(motion.state[:-1, VX])
    axes.add_collection(lines)
    axes.figure.colorbar(lines, ax=axes, label="vx (m/s)")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)


def _travelled(motion: Motion) -> np.ndarray:
    steps = np.hypot(*np.diff(motion.state[:, [X, Y]], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])
