"""Vehicles from above: the driven one, with wheels and tyre forces, and the others around it."""

import math
from typing import NamedTuple

import numpy as np
import pygame
from numpy.typing import ArrayLike, NDArray

from lpv_track_env import bicycle, kernels
from lpv_track_env.bicycle import PSI, X, Y
from lpv_track_env.rendering import canvas
from lpv_track_env.rendering.canvas import SUPERSAMPLING, View
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]

WHEEL = (0.72, 0.27)
"""Length and width of a wheel, m."""
CORNERS = 5
"""Points of a rounded corner."""
FORCE_LENGTH = 1.8
"""Length of an arrow, m per m/s^2 that the axle's force accelerates the vehicle."""
LEAST_FORCE = 0.15
"""m/s^2 below which no arrow is drawn: it would be all head."""
LONGEST_FORCE = 9.0
"""Largest length of an arrow, m."""

OTHER_SHAPE = np.array(
    [(-0.5, -0.5), (0.42, -0.5), (0.5, -0.32), (0.5, 0.32), (0.42, 0.5), (-0.5, 0.5)]
)
"""Outline of the body (6, 2) in shares of length and width, from its middle, x forwards."""
OTHER_WINDSCREEN = np.array([(0.32, -0.36), (0.32, 0.36), (0.18, 0.44), (0.18, -0.44)])
"""Windscreen (4, 2), in the same shares."""


class AxleForces(NamedTuple):
    """Lateral forces of the axles, N, and their slip angles, rad; positive to the left."""

    front: float
    rear: float
    front_slip: float
    rear_slip: float


def axle_forces(
    vx: float, vy: float, yaw_rate: float, steering_angle: float, car: VehicleParameters
) -> AxleForces:
    """Compute the axle forces of linear tyres, taken from `bicycle.field`.

    They follow from the nominal parameters; another plant, or conditions that change the vehicle,
    have other forces.
    """
    caf, rear_stiffness = car.front_cornering_stiffness, car.rear_cornering_stiffness
    cosine = math.cos(steering_angle)

    def sideward(front_stiffness: float, other: float) -> float:
        """Force m (vy' + r vx), N, of the axle whose stiffness is not 0."""
        parameters = car.as_array()
        parameters[4], parameters[5] = front_stiffness, other
        rates = bicycle.field(
            vx, vy, yaw_rate, 1.0, 0.0, 0.0, steering_angle, cosine, math.sin(steering_angle),
            float(bicycle.inverse_speed(vx)), *parameters.tolist(),
        )  # fmt: skip
        return car.mass * float(rates[1] + yaw_rate * vx)

    # The front force is normal to the wheels; the field has its component across the body.
    front, rear = sideward(caf, 0.0) / cosine, sideward(0.0, rear_stiffness)
    return AxleForces(front, rear, front / caf, rear / rear_stiffness)


def ackermann(steering_angle: float, wheelbase: float, track: float) -> tuple[float, float]:
    """Angles (rad) of the left and right front wheel for the bicycle's steering angle.

    The axes of all wheels then meet in one point, on the line of the rear axle.
    """
    sine, cosine = math.sin(steering_angle), math.cos(steering_angle)
    return (
        math.atan2(wheelbase * sine, wheelbase * cosine - 0.5 * track * sine),
        math.atan2(wheelbase * sine, wheelbase * cosine + 0.5 * track * sine),
    )


class VehicleDrawing:
    """Shapes of the driven vehicle about its centre of gravity, x forwards, y to the left."""

    def __init__(self, car: VehicleParameters) -> None:
        self._car = car
        half, side = 0.5 * car.length, 0.5 * car.width
        middle = 0.5 * (car.front_axle_distance - car.rear_axle_distance)
        centre = np.array([middle, 0.0])
        self._body = _rounded(half, side, 0.55, 0.3) + centre
        front = _across(half - 0.24 * car.length, side * 0.76, side * 0.86, 0.09 * car.length)
        rear = _across(0.08 * car.length - half, side * 0.8, side * 0.72, 0.06 * car.length)
        self._glass = (front + centre, rear + centre)
        lamp = np.array([(0.0, 0.0), (0.0, 0.34 * side), (-0.18, 0.4 * side), (-0.18, 0.0)])
        at = np.array([half - 0.03, 0.38 * side])
        self._lamps = (lamp + at + centre, (lamp + at) * (1.0, -1.0) + centre)
        self._half_track = side - 0.55 * WHEEL[1]

    def draw(self, surface: pygame.Surface, view: View, record: Array) -> None:
        """Draw the vehicle at the pose in an episode's record, its front wheels steered."""
        car, psi = self._car, float(record[PSI])
        place = np.array([record[X], record[Y]])

        def fill(colour: tuple[int, int, int], points: Array) -> None:
            corners = view.pixels(canvas.turned(points, psi) + place).tolist()
            pygame.draw.polygon(surface, colour, corners)

        shade = view.pixels(canvas.turned(self._body, psi) + place + np.array([0.18, -0.22]))
        pygame.draw.polygon(surface, canvas.SHADOW, shade.tolist())
        fill(canvas.BODY, self._body)
        for lamp in self._lamps:
            fill(canvas.LAMP, lamp)
        for glass in self._glass:
            fill(canvas.GLASS, glass)
        angles = ackermann(float(record[kernels.STEERING]), car.wheelbase, 2.0 * self._half_track)
        for axle, turns in (
            (car.front_axle_distance, angles),
            (-car.rear_axle_distance, (0.0, 0.0)),
        ):
            for side, angle in zip((self._half_track, -self._half_track), turns, strict=True):
                fill(canvas.TYRE, canvas.turned(_rectangle(*WHEEL), angle) + np.array([axle, side]))
        outline = view.pixels(canvas.turned(np.vstack([self._body, self._body[:1]]), psi) + place)
        canvas.polyline(surface, canvas.OUTLINE, outline, 1.3 * SUPERSAMPLING)
        pygame.draw.circle(surface, canvas.INK, view.pixels(place).tolist(), 2 * SUPERSAMPLING)

    def draw_forces(
        self, surface: pygame.Surface, view: View, record: Array, forces: AxleForces
    ) -> None:
        """Draw the axles' lateral forces as arrows from their middles."""
        car, psi = self._car, float(record[PSI])
        place = np.array([record[X], record[Y]])
        steered = psi + float(record[kernels.STEERING])
        for axle, force, heading in (
            (car.front_axle_distance, forces.front, steered),
            (-car.rear_axle_distance, forces.rear, psi),
        ):
            strength = force / car.mass
            if not math.isfinite(strength) or abs(strength) < LEAST_FORCE:
                continue
            length = min(FORCE_LENGTH * abs(strength), LONGEST_FORCE)
            start = place + axle * np.array([math.cos(psi), math.sin(psi)])
            left = math.copysign(1.0, strength) * np.array([-math.sin(heading), math.cos(heading)])
            arrow(surface, view.pixels(start), view.pixels(start + length * left))


def arrow(surface: pygame.Surface, start: Array, end: Array) -> None:
    """Draw an arrow between two pixels (2,)."""
    along = end - start
    size = math.hypot(*along)
    if size == 0.0:
        return
    along = along / size
    across = np.array([-along[1], along[0]])
    head = min(7.0 * SUPERSAMPLING, 0.6 * size)
    neck = end - head * along
    half = 1.4 * SUPERSAMPLING
    shape = [
        start + half * across, neck + half * across, neck + 0.5 * head * across, end,
        neck - 0.5 * head * across, neck - half * across, start - half * across,
    ]  # fmt: skip
    pygame.draw.polygon(surface, canvas.FORCE, [point.tolist() for point in shape])


def draw_others(surface: pygame.Surface, view: View, others: ArrayLike) -> None:
    """Draw other vehicles, (m, 5) [X m, Y m, heading rad, length m, width m].

    Vehicles out of sight, and rows that are not finite, are left out.

    Raises
    ------
    ValueError
        If the shape is not (m, 5).
    """
    rows = np.asarray(others, dtype=np.float64)
    if rows.size == 0:
        return
    if rows.ndim != 2 or rows.shape[1] != 5:
        raise ValueError(f"others must be (m, 5): X, Y, heading, length, width; got {rows.shape}")
    rows = rows[np.isfinite(rows).all(axis=1)]
    reach = np.hypot(rows[:, 3:4], rows[:, 4:5])
    for k in view.visible(rows[:, :2] - reach, rows[:, :2] + reach):
        x, y, heading, length, width = rows[k].tolist()
        for shape, colour in ((OTHER_SHAPE, canvas.OTHER), (OTHER_WINDSCREEN, canvas.OTHER_GLASS)):
            corners = canvas.turned(shape * (length, width), heading) + np.array([x, y])
            pygame.draw.polygon(surface, colour, view.pixels(corners).tolist())


def _rectangle(length: float, width: float) -> Array:
    """Corners (4, 2) of a rectangle about the origin, its length along x."""
    return np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)]) * (length, width)


def _across(x: float, ahead: float, behind: float, length: float) -> Array:
    """Corners (4, 2) of a window across the body: half widths at x and at `length` behind x."""
    return np.array([(x, ahead), (x, -ahead), (x - length, -behind), (x - length, behind)])


def _rounded(half: float, side: float, front: float, rear: float) -> Array:
    """Outline of a rectangle with rounded corners of radii `front` and `rear`, m."""
    points = []
    for sx, sy, start in ((1, 1, 0), (-1, 1, 1), (-1, -1, 2), (1, -1, 3)):
        radius = min(front if sx > 0 else rear, side)
        turn = 0.5 * math.pi * (start + np.linspace(0.0, 1.0, CORNERS))
        middle = np.array([sx * (half - radius), sy * (side - radius)])
        points.append(middle + radius * np.column_stack([np.cos(turn), np.sin(turn)]))
    return np.vstack(points)
