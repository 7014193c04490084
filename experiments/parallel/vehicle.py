"""The simulated vehicle and its drive-by-wire interface, which brakes when nobody drives it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.base import stopping_acceleration
from experiments.parallel.messages import STALE_PERIODS
from experiments.parallel.setup import MS_PER_SECOND, STEP, Setup, undelayed
from lpv_track_env.bicycle import VX
from lpv_track_env.conditions import SIMULATION, Conditions, load
from lpv_track_env.env import PathTrackingEnv

Array = NDArray[np.float64]

CORRIDOR = 5.0
"""m: a vehicle this far from the path has left it."""
STANDSTILL = 0.01
"""m/s."""
LONGEST_STOP = 60.0
"""s of simulated time that a stop may take."""
FOR_EVER = 1e9
"""s."""


@dataclass
class StaleBraking:
    """One time that the vehicle braked because it was left alone; times on its clock, s."""

    began: float
    age: float
    """Of the estimate behind the last command, when it began."""
    ended: float | None = None


def plant_conditions(setup: Setup) -> Conditions | str:
    """A run's conditions as far as they are the vehicle's: sensors and computers are elsewhere."""
    conditions = load(setup.conditions)
    if conditions is None:
        return SIMULATION
    return undelayed(conditions).replace(
        estimator="truth", max_fix_age=FOR_EVER, max_command_age=FOR_EVER
    )


class Vehicle:
    """The project's plant in steps of 1 ms, driven by the latest command.

    A command counts until the estimate that it answers is three control periods old on the
    vehicle's own clock (the command itself is younger). Then the vehicle brakes: steering held,
    controlled deceleration down to standstill, until there is a command it can trust.

    Parameters
    ----------
    setup
        The run's.
    """

    def __init__(self, setup: Setup) -> None:
        # Where it is for a drive to end is decided here, so that it can still brake afterwards.
        self.env = PathTrackingEnv(
            setup.trajectory, setup.vehicle, conditions=plant_conditions(setup),
            control_period=STEP, max_lateral_error=1000.0,
            time_limit=2.0 * setup.seconds + LONGEST_STOP,
        )  # fmt: skip
        self.env.reset(seed=setup.seed)
        # A first step has code loaded or compiled, for which there is no time while driving.
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
        """Acceleration (m/s^2) and steering angle (rad) that the actuators report."""
        return self.env.actuators

    @property
    def time(self) -> float:
        """Time on the vehicle's clock, s."""
        return self._steps * STEP

    @property
    def age(self) -> float:
        """Age of what the command in force answers, s."""
        return self.time - self._answered

    @property
    def speed(self) -> float:
        """True vx, m/s."""
        return float(self.info["state"][VX])

    @property
    def end(self) -> str | None:
        """Why the drive cannot go on: finished, left_corridor, wrong_heading, non_finite."""
        if "end" in self.info:
            return str(self.info["end"])
        return "left_corridor" if abs(self.info["lateral_error"]) > CORRIDOR else None

    def take(self, acceleration: float, steering_angle: float, answered: float) -> bool:
        """Take a command that answers what was sensed at `answered` (s); whether it was taken.

        One that is not finite is not: then the vehicle goes on with the last, and soon brakes.
        """
        if not (math.isfinite(acceleration) and math.isfinite(steering_angle)):
            self.commands_refused += 1
            return False
        self._command = [acceleration, steering_angle]
        self._answered = answered
        return True

    def advance(self, until: float) -> None:
        """Drive all steps that begin before `until` (s), braking in those that are left alone."""
        steps = math.ceil(until * MS_PER_SECOND - 1e-6)
        while self._steps < steps and "end" not in self.info:
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
        """Mean inputs in force since this was last asked, m/s^2 and rad."""
        if self._summed == 0:
            return self.in_force
        a, delta = self._sums / self._summed
        self._sums[:] = 0.0
        self._summed = 0
        return float(a), float(delta)

    def stop(self) -> tuple[float, float]:
        """Brake to standstill, simulated at once: time (s) and distance (m) that it took.

        It ends early where the path does.
        """
        began, start = self._steps, self.info["arc_length"]
        self._command[1] = self.in_force[1]
        while (
            self.speed > STANDSTILL
            and "end" not in self.info
            and self._steps - began < LONGEST_STOP * MS_PER_SECOND
        ):
            self._command[0] = stopping_acceleration(self.env.vehicle, self.speed)
            self._step()
        return (self._steps - began) * STEP, self.info["arc_length"] - start
