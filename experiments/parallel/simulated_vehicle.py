"""The simulated vehicle: plant, drive-by-wire interface that brakes by itself, and sensors."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import stopping_acceleration
from experiments.parallel.setup import (
    INERTIAL_MS,
    MS_PER_SECOND,
    SAMPLE,
    STALE_PERIODS,
    STEP,
    WHEEL_MS,
    Setup,
)
from lpv_track_env.bicycle import PSI, VX, YAW_RATE, X, Y
from lpv_track_env.conditions import IDEAL, SIMULATION, Conditions, load, sensors
from lpv_track_env.env import PathTrackingEnv

Array = NDArray[np.float64]

CORRIDOR = 5.0
"""Lateral error at which the vehicle has left the corridor, m."""
STANDSTILL = 0.01
"""Speed that counts as standing, m/s."""
LONGEST_STOP = 60.0
"""Largest simulated time of a stop, s."""
REHEARSED_MS = 2000
"""Length of a rehearsal, ms: several fixes at any rate."""
FOR_EVER = 1e9
"""Age limit that is never reached, s."""


@dataclass
class StaleBraking:
    """A phase of braking for lack of fresh commands; times on the vehicle's clock, s."""

    began: float
    age: float
    """Age of the estimate behind the last command at the beginning."""
    ended: float | None = None


def plant_conditions(setup: Setup) -> Conditions | str:
    """Return the run's conditions of the vehicle alone, without sensors and computing delay."""
    conditions = load(setup.conditions)
    if conditions is None:
        return SIMULATION
    return conditions.replace(
        computing_delay=0.0, estimator="truth", max_fix_age=FOR_EVER, max_command_age=FOR_EVER
    )


class Vehicle:
    """The environment's plant in steps of 1 ms, driven by the latest command.

    A command is valid until the estimate behind it is three control periods old on the vehicle's
    own clock. Then the vehicle brakes with the steering held, at a controlled deceleration down to
    standstill, until a valid command arrives.
    """

    def __init__(self, setup: Setup) -> None:
        # The corridor is checked in `end`, so that the vehicle can still brake after leaving it.
        self.env = PathTrackingEnv(
            setup.trajectory, setup.vehicle, conditions=plant_conditions(setup),
            control_period=STEP, max_lateral_error=1000.0,
            time_limit=2.0 * setup.seconds + LONGEST_STOP,
        )  # fmt: skip
        self.env.reset(seed=setup.seed)
        # The first step loads or compiles code, which would be too slow while driving.
        self.env.step([0.0, 0.0])  # type: ignore[arg-type]
        _, self.info = self.env.reset(seed=setup.seed)
        self._steps = 0
        self._stale_after = STALE_PERIODS * setup.period
        self._command = list(self.in_force)
        self._answered = 0.0
        self._sums = np.zeros(2)
        self._summed = 0
        self.braking: StaleBraking | None = None
        self.stale_brakings: list[StaleBraking] = []
        self.commands_refused = 0

    @property
    def in_force(self) -> tuple[float, float]:
        """Acceleration (m/s^2) and steering angle (rad) reported by the actuators."""
        return self.env.actuators

    @property
    def time(self) -> float:
        """Time on the vehicle's clock, s."""
        return self._steps * STEP

    @property
    def age(self) -> float:
        """Age of the estimate behind the command in force, s."""
        return self.time - self._answered

    @property
    def speed(self) -> float:
        """True vx, m/s."""
        return float(self.info["state"][VX])

    @property
    def end(self) -> str | None:
        """Why the drive ends: finished, left_corridor, wrong_heading or non_finite; else None."""
        if self.info["end"]:
            return str(self.info["end"])
        return "left_corridor" if abs(self.info["lateral_error"]) > CORRIDOR else None

    def take(self, acceleration: float, steering_angle: float, answered: float) -> bool:
        """Take a command based on the sample of time `answered` (s); return whether it is valid.

        A command that is not finite is refused: the vehicle keeps the last one, and soon brakes.
        """
        if not (math.isfinite(acceleration) and math.isfinite(steering_angle)):
            self.commands_refused += 1
            return False
        self._command = [acceleration, steering_angle]
        self._answered = answered
        return True

    def advance(self, until: float) -> None:
        """Advance by all steps that begin before `until` (s), braking if the command is stale."""
        steps = math.ceil(until * MS_PER_SECOND - 1e-6)
        while self._steps < steps and not self.info["end"]:
            if self.age > self._stale_after - 0.5 * STEP:
                if self.braking is None:
                    self.braking = StaleBraking(self.time, self.age)
                    self.stale_brakings.append(self.braking)
                    self._command[1] = self.in_force[1]
                self._command[0] = stopping_acceleration(self.env.vehicle, self.speed)
            elif self.braking is not None:
                self.braking.ended = self.time
                self.braking = None
            self._step()

    def _step(self) -> None:
        _, _, _, _, self.info = self.env.step(self._command)  # type: ignore[arg-type]
        self._steps += 1
        self._sums += self.in_force
        self._summed += 1

    def mean_inputs(self) -> tuple[float, float]:
        """Return the mean inputs in force since the last call, m/s^2 and rad."""
        if self._summed == 0:
            return self.in_force
        a, delta = self._sums / self._summed
        self._sums[:] = 0.0
        self._summed = 0
        return float(a), float(delta)

    def stop(self) -> tuple[float, float]:
        """Simulate braking to standstill at once; return its time (s) and distance (m).

        It ends early if the path does.
        """
        began, start = self._steps, self.info["arc_length"]
        self._command[1] = self.in_force[1]
        while (
            self.speed > STANDSTILL
            and not self.info["end"]
            and self._steps - began < LONGEST_STOP * MS_PER_SECOND
        ):
            self._command[0] = stopping_acceleration(self.env.vehicle, self.speed)
            self._step()
        return (self._steps - began) * STEP, self.info["arc_length"] - start


class Sensors:
    """Sensors of the vehicle, each at its own rate, with the errors of `conditions.sensors`.

    Without conditions they are perfect; `fix_ms` (ms) is the time between fixes.
    """

    def __init__(self, conditions: Conditions | None, fix_ms: int, seed: int) -> None:
        self.conditions = conditions or IDEAL
        self._sensors = sensors.Sensors(self.conditions, seed)
        self._latency = self._sensors.drawn["gnss_latency"]
        self._fix_ms = fix_ms
        self._coming: deque[tuple[int, float, float, float]] = deque()
        """Fixes on their way: arrival (ms), stamp (s), x and y (m)."""

    def read(self, ms: int, state: Array, record: Any) -> None:
        """Write the readings at time `ms` into a SAMPLE record, NaN where a sensor has none."""
        time = ms / MS_PER_SECOND
        for name in ("heading", "yaw_rate", "speed", "fix_time", "fix_x", "fix_y"):
            record[name] = math.nan
        if ms % INERTIAL_MS == 0:
            record["heading"], record["yaw_rate"] = self._sensors.inertial(
                time, state[PSI], state[YAW_RATE]
            )
        if ms % WHEEL_MS == 0:
            record["speed"] = self._sensors.wheel_speed(state[VX])
        if ms % self._fix_ms == 0:
            self._measure_fix(ms, time, state)
        if self._coming and self._coming[0][0] <= ms:
            _, record["fix_time"], record["fix_x"], record["fix_y"] = self._coming.popleft()

    def _measure_fix(self, ms: int, time: float, state: Array) -> None:
        """Queue a fix of this moment unless it is lost; the first fix arrives at once."""
        if ms == 0:
            self._coming.append((ms, time, *self._sensors.first_fix(state[X], state[Y])))
            return
        fix = self._sensors.fix(time, state[X], state[Y])
        if fix is not None:
            arrives = ms + math.ceil(MS_PER_SECOND * self._latency - 1e-6)
            self._coming.append((arrives, time, *fix))


def rehearse(setup: Setup) -> None:
    """Simulate the first seconds of a drive at once, so that all code that it calls is compiled."""
    vehicle, record = Vehicle(setup), np.zeros((), SAMPLE)
    sensors = Sensors(setup.known_conditions, setup.fix_ms, setup.seed)
    for ms in range(0, REHEARSED_MS, setup.tick_ms):
        vehicle.advance(ms / MS_PER_SECOND)
        sensors.read(ms, vehicle.info["state"], record)
    vehicle.stop()
