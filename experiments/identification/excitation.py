"""Drives that excite a vehicle richly, recorded as logs for identification.

The vehicle follows a straight line at a speed that rises and falls, while sums of sines are added
to steering and acceleration. Sensors have white noise.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.identification.log import CHANNELS
from lpv_track_env.vehicle import VehicleParameters
from trajectories.fileio import write_atomically
from trajectories.path import ReferencePath

Array = NDArray[np.float64]

NOISE: Mapping[str, float] = {
    "vx": 0.03, "vy": 0.05, "heading": 0.005, "yaw_rate": 0.005, "x": 0.03, "y": 0.03,
}  # fmt: skip
"""Standard deviations of the sensors: m/s, m/s, rad, rad/s, m, m; those of a good inertial
navigation system with corrected satellite positions."""
TONES = 8
"""Number of sines for each command."""
STEERING_BAND, DRIVE_BAND = (0.1, 1.6), (0.05, 0.7)
"""Hz, of the tones that are added."""
RETURN_TIME = 3.0
"""Time within which the vehicle is steered back to the line, s."""
ROUND = 40.0
"""Period of the mean speed, s."""


class Exciter:
    """Commands of an excitation.

    Parameters
    ----------
    vehicle
        The vehicle as it is believed to be: it sizes the tones.
    speeds
        Lowest and highest mean speed, m/s.
    lateral_acceleration
        About the largest lateral acceleration, m/s^2.
    seed
        Seed of the tones' frequencies and phases.
    """

    def __init__(
        self,
        vehicle: VehicleParameters,
        speeds: tuple[float, float],
        lateral_acceleration: float,
        seed: int,
    ) -> None:
        self.vehicle, self.speeds, self.lateral = vehicle, speeds, lateral_acceleration
        rng = np.random.default_rng(seed)
        self._tones = [
            (rng.uniform(*band, TONES), rng.uniform(0.0, 2.0 * math.pi, TONES))
            for band in (STEERING_BAND, DRIVE_BAND)
        ]
        self._last = np.zeros(2)

    def _tone(self, command: int, time: float) -> float:
        """Return the sum of a command's tones, which rarely exceeds 1."""
        frequencies, phases = self._tones[command]
        sines = np.sin(2.0 * math.pi * frequencies * time + phases)
        return float(np.sum(sines)) / (2.0 * math.sqrt(0.5 * TONES))

    def wanted_speed(self, time: float) -> float:
        """Return the mean speed at a time, m/s."""
        low, high = self.speeds
        return 0.5 * (low + high) - 0.5 * (high - low) * math.cos(2.0 * math.pi * time / ROUND)

    def command(self, time: float, state: Array, period: float) -> Array:
        """Return [a, delta] for the period from `time` on, within ranges and rates."""
        car = self.vehicle
        vx, _, psi, _, _, y = state.tolist()
        speed = max(vx, 1.0)
        per_angle = speed**2 / (car.wheelbase + max(car.understeer_gradient, 0.0) * speed**2)
        limit = self.lateral / per_angle
        back = -(y / (speed * RETURN_TIME) + psi) / RETURN_TIME * 3.0
        delta = limit * self._tone(0, time) + np.clip(back * car.wheelbase / speed, -limit, limit)
        low, high = car.longitudinal_acceleration_range
        strength = 0.5 * min(-low, high, self.speeds[0])
        a = (
            car.rolling_deceleration
            + strength * self._tone(1, time)
            + 0.5 * (self.wanted_speed(time) - vx)
        )
        steps = np.array([car.max_jerk, car.max_steering_rate]) * period * (1.0 - 1e-6)
        wanted = np.clip([a, delta], self._last - steps, self._last + steps)
        bounds = np.array([[*car.acceleration_range], [-1.0, 1.0]])
        bounds[1] *= car.max_steering_angle
        # As the action space holds them.
        self._last = np.clip(wanted, *bounds.T).astype(np.float32).astype(np.float64)
        return self._last


def record(
    file: Path,
    vehicle: VehicleParameters,
    *,
    seconds: float = 180.0,
    period: float = 0.02,
    speeds: tuple[float, float] = (6.0, 14.0),
    lateral_acceleration: float = 2.5,
    noise: float = 1.0,
    seed: int = 0,
    on_step: Callable[[float], None] = lambda _: None,
    **settings: Any,
) -> dict[str, Array]:
    """Drive a simulated vehicle, write its log as CSV, and return the true values by column.

    Parameters
    ----------
    file
        CSV file for `lpv-track identify`.
    vehicle
        The vehicle.
    seconds, period
        Length of the drive and time between samples and commands, s.
    speeds, lateral_acceleration, seed
        See `Exciter`; the seed also draws the noise.
    noise
        Factor of `NOISE`; 0 gives true values.
    on_step
        Called with the time of each step, s.
    **settings
        Arguments of the environment, such as `plant` and `conditions`.

    Raises
    ------
    ValueError
        For a setting that the environment refuses, or a drive that ends early.
    """
    import gymnasium

    from lpv_track_env import PATH_TRACKING

    length = max(speeds[1] * seconds * 1.5, 100.0)
    count = 200
    line = np.linspace(0.0, length, count)
    flat = np.zeros(count)
    path = ReferencePath(line, line, flat, flat, flat, np.full(count, speeds[0]), "excitation")
    bounds = {"max_lateral_error": 1e3, "time_limit": seconds + 1.0}
    env = gymnasium.make(
        PATH_TRACKING, trajectory=path, vehicle=vehicle, control_period=period,
        **{**bounds, **settings},
    )  # fmt: skip
    exciter = Exciter(vehicle, speeds, lateral_acceleration, seed)
    _, info = env.reset(seed=seed, options={"speed": speeds[0]})
    rows = [info["state"]]
    sent = []
    for k in range(round(seconds / period)):
        command = exciter.command(k * period, rows[-1], period)
        *_, terminated, truncated, info = env.step(command.astype(np.float32))
        sent.append(command)
        rows.append(info["state"])
        on_step(k * period)
        if terminated or truncated:
            raise ValueError(f"the drive ended after {k * period:.1f} s: {info['end']}")
    states = np.array(rows)
    true = {
        "time": period * np.arange(len(states)),
        **{name: states[:, column] for column, name in enumerate(CHANNELS)},
        "acceleration_command": np.array([*sent, sent[-1]])[:, 0],
        "steering_command": np.array([*sent, sent[-1]])[:, 1],
    }
    rng = np.random.default_rng([seed, 1])
    logged = {
        name: values + noise * NOISE.get(name, 0.0) * rng.standard_normal(len(values))
        for name, values in true.items()
    }
    text = [",".join(logged)]
    text += [",".join(map(repr, row)) for row in np.column_stack([*logged.values()]).tolist()]
    write_atomically(file, ("\n".join(text) + "\n").encode())
    return true
