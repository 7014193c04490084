"""Plausible ranges of a vehicle's parameters, and the units that other values suggest.

A file with degrees for radians is read without an error and drives wrongly. Ranges reach from
model cars of 40 g to trucks of 40 t; they bind unless the vehicle says that it is `implausible`.
What cannot be computed with is refused in any case.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from trajectories import speed
from trajectories.arguments import shown

GRAVITY = speed.GRAVITY


class Range(NamedTuple):
    """Plausible values in a unit; `others` are units that are mistaken for it, and their size."""

    low: float
    high: float
    unit: str
    others: tuple[tuple[str, float], ...] = ()


DEGREE = math.pi / 180.0
LENGTHS = (("mm", 1e-3), ("cm", 1e-2))
PLAUSIBLE: Mapping[str, Range] = {
    "mass": Range(0.01, 1e5, "kg"),
    "front_axle_distance": Range(0.01, 15.0, "m", LENGTHS),
    "rear_axle_distance": Range(0.01, 15.0, "m", LENGTHS),
    "centre_of_gravity_height": Range(0.005, 4.0, "m", LENGTHS),
    "rolling_resistance": Range(0.0, 0.5, "", (("%", 1e-2),)),
    "max_steering_angle": Range(0.01, 0.5 * math.pi, "rad", (("deg", DEGREE),)),
    "max_steering_rate": Range(0.01, 15.0, "rad/s", (("deg/s", DEGREE),)),
    "acceleration_range": Range(-60.0, 60.0, "m/s^2"),
    "max_jerk": Range(0.01, 1e4, "m/s^3"),
    "longitudinal_acceleration_range": Range(-60.0, 60.0, "m/s^2"),
    "max_lateral_acceleration": Range(0.01, 60.0, "m/s^2"),
    "speed_range": Range(-110.0, 110.0, "m/s", (("km/h", 1.0 / 3.6),)),
    "max_lateral_velocity_ratio": Range(0.001, 2.0, ""),
    "length": Range(0.05, 30.0, "m", LENGTHS),
    "width": Range(0.03, 5.0, "m", LENGTHS),
}
"""Ranges that hold for every vehicle."""
STIFFNESS_PER_LOAD = (1.0, 100.0)
"""1/rad, of an axle's cornering stiffness and its static load; tyres of cars have 5 to 30."""
INERTIA_RATIO = (0.1, 10.0)
"""Ratio of the yaw inertia to m lf lr; cars have about 1."""
STIFFNESSES = (("N/deg", 1.0 / DEGREE), ("kN/rad", 1e3), ("kN/deg", 1e3 / DEGREE))

COMPUTABLE = (1e-9, 1e9)
"""Smallest and largest magnitude of any parameter but 0."""
FASTEST_POLE = 1e4
"""1/s: faster lateral dynamics would need integration steps below 0.15 ms."""
INVERSE_SPEED_AT_STANDSTILL = 15.0 / 8.0
"""s/m, of `bicycle.inverse_speed`."""


def check_computable(values: Mapping[str, Any]) -> None:
    """Refuse parameters whose dynamics cannot be integrated in reasonable time.

    At standstill the lateral poles are real and negative; their sum bounds the fastest.

    Raises
    ------
    ValueError
        In one line with the number.
    """
    name = f"vehicle {shown(values['name'])}"
    for key, value in _numbers(values):
        if value != 0.0 and not COMPUTABLE[0] <= abs(value) <= COMPUTABLE[1]:
            raise ValueError(
                f"{name}: {key} is {value:g}; {COMPUTABLE[0]:g} to {COMPUTABLE[1]:g} can be "
                "computed with"
            )
    lf, lr = values["front_axle_distance"], values["rear_axle_distance"]
    caf, car = values["front_cornering_stiffness"], values["rear_cornering_stiffness"]
    pole = INVERSE_SPEED_AT_STANDSTILL * (
        (caf + car) / values["mass"] + (caf * lf**2 + car * lr**2) / values["yaw_inertia"]
    )
    if pole > FASTEST_POLE:
        raise ValueError(
            f"{name}: its tyres would stop sliding at a rate of {pole:.3g} 1/s, at most "
            f"{FASTEST_POLE:g} 1/s can be integrated: check mass {values['mass']:g} kg, yaw_inertia"
            f" {values['yaw_inertia']:g} kg m^2 and cornering stiffnesses {caf:g} and {car:g} N/rad"
        )


def check_plausible(values: Mapping[str, Any]) -> None:
    """Refuse parameters that suggest another unit, unless the vehicle is `implausible`.

    Raises
    ------
    ValueError
        In one line with the value, the plausible range, and a unit in which it would be plausible.
    """
    if values["implausible"]:
        return
    ranges = {**PLAUSIBLE, **_ranges_by_mass(values)}
    # Masses and lengths before what depends on them.
    for key, value in sorted(_numbers(values), key=lambda number: number[0] not in PLAUSIBLE):
        low, high, unit, others = ranges[key]
        if low <= value <= high:
            continue
        hints = [
            f"; {other}? {value:g} {other} = {value * size:.4g} {unit}".rstrip()
            for other, size in others
            if low <= value * size <= high
        ]
        mass = values["mass"]
        if key not in PLAUSIBLE:
            hints.append(f"; is the mass {mass:g} kg?" if mass < 100.0 else "")
        raise ValueError(
            f"vehicle {shown(values['name'])}: {key} {value:g} {unit}".rstrip()
            + f" is implausible, expected {low:.4g} to {high:.4g}{''.join(hints)} "
            '("implausible": true takes it as it is)'
        )


def _numbers(values: Mapping[str, Any]) -> list[tuple[str, float]]:
    """List the parameters by name, both ends of ranges."""
    found: list[tuple[str, float]] = []
    for key, value in values.items():
        if isinstance(value, tuple):
            found.extend((key, float(end)) for end in value)
        elif not isinstance(value, str | bool):
            found.append((key, float(value)))
    return found


def _ranges_by_mass(values: Mapping[str, Any]) -> dict[str, Range]:
    """Return the ranges that follow from the mass and the axles' places."""
    lf, lr, mass = values["front_axle_distance"], values["rear_axle_distance"], values["mass"]
    weight = mass * GRAVITY / (lf + lr)
    front, rear = weight * lr, weight * lf
    low, high = STIFFNESS_PER_LOAD
    inertia = mass * lf * lr
    return {
        "front_cornering_stiffness": Range(low * front, high * front, "N/rad", STIFFNESSES),
        "rear_cornering_stiffness": Range(low * rear, high * rear, "N/rad", STIFFNESSES),
        "yaw_inertia": Range(INERTIA_RATIO[0] * inertia, INERTIA_RATIO[1] * inertia, "kg m^2"),
    }
