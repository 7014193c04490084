"""Settings of a parallel run and the messages between its processes.

Messages are numpy records in SI units; NaN stands for a quantity that was not measured. `due` is
the instant at which the sample behind a message was due, ns of `time.monotonic_ns()`, a clock that
all processes share.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import trajectories
from agents.registry import check_settings
from lpv_track_env import vehicle
from lpv_track_env.conditions import IDEAL, SIMULATION, Conditions, load
from lpv_track_env.env import PathTrackingEnv
from trajectories.naming import choose

MS = 1_000_000
"""Nanoseconds per millisecond."""
MS_PER_SECOND = 1000
STEP = 1.0 / MS_PER_SECOND
"""Cycle of the simulated vehicle, s: integration step, and grid on which commands take effect."""
INERTIAL_MS, WHEEL_MS = 10, 20
"""Time between readings, ms: IMU and heading at 100 Hz, wheels at 50 Hz."""
ESTIMATORS = ("ekf", "truth")

SAMPLE = np.dtype(
    [
        ("period", np.int64),  # number of its control period, from 0
        ("due", np.int64),
        ("time", np.float64),  # s on the vehicle's clock
        ("mean_acceleration", np.float64),  # reported by the actuators, mean since the last
        ("mean_steering_angle", np.float64),  # sample: m/s^2, rad
        ("acceleration", np.float64),  # in force now
        ("steering_angle", np.float64),
        ("heading", np.float64),  # rad
        ("yaw_rate", np.float64),  # rad/s
        ("speed", np.float64),  # of the wheels, m/s
        ("fix_time", np.float64),  # s on the vehicle's clock, when the position was measured
        ("fix_x", np.float64),  # m
        ("fix_y", np.float64),
        ("truth", np.float64, (6,)),  # [vx, vy, psi, r, X, Y], for `--estimator truth` alone
    ]
)
"""Message from the vehicle to the estimator."""

ESTIMATE = np.dtype(
    [
        ("period", np.int64),
        ("due", np.int64),  # of the newest sample in it
        ("time", np.float64),
        ("state", np.float64, (6,)),  # [vx, vy, psi, r, X, Y]
        ("acceleration", np.float64),  # in force at that time
        ("steering_angle", np.float64),
        ("position_deviation", np.float64),  # m, standard deviation in the worst direction
        ("fix_age", np.float64),  # s since the last fix that was used
        ("steering_offset", np.float64),  # rad, angle of the wheels minus the reported one
        ("fixes_used", np.int64),
        ("fixes_refused", np.int64),  # gated, late, duplicate or not finite
        ("readings_refused", np.int64),  # gated or not finite
        ("samples_lost", np.int64),  # overwritten before they were read
    ]
)
"""Message from the estimator to the controller (and to the run's report)."""

COMMAND = np.dtype(
    [
        ("period", np.int64),
        ("due", np.int64),  # of the estimate that it answers
        ("estimated", np.int64),  # when that estimate was written
        ("acceleration", np.float64),  # m/s^2
        ("steering_angle", np.float64),  # rad
        ("solve_time", np.float64),  # of the agent's `predict`, s; 0 if it was not called
        ("reason", np.int64),  # DRIVING, or why the controller brakes
        ("failures", np.int64),  # calls of `predict` that failed, so far
    ]
)
"""Message from the controller to the vehicle."""

DRIVING, STALE_ESTIMATE, NO_FIX, NOT_FINITE, FAILED = range(5)
REASONS = ("driving", "stale estimate", "no fix", "estimate not finite", "failed solve")
"""Reasons for a command, by code: all but `DRIVING` brake."""

STALE_PERIODS = 3
"""Age in control periods at which an estimate, or a command based on it, is stale."""


@dataclass(frozen=True)
class Setup:
    """Settings of a run, passed to its processes.

    Parameters
    ----------
    trajectory, vehicle, agent, agent_settings
        As in the other commands.
    rate
        Control rate, Hz; a divisor of 1000.
    seconds
        Length of the run, s; it ends earlier if the path does.
    conditions
        Conditions of sensors, actuators and vehicle, as `lpv_track_env.conditions.load` takes them.
    estimator
        "ekf", or "truth": the true state is passed on as the estimate.
    seed
        Seed of the sensors' noise.
    watchdog
        Control periods without a new command after which the silent process counts as hung.

    Raises
    ------
    ValueError
        For a setting out of range or an unknown name.
    """

    trajectory: str = "T2"
    vehicle: str = "m2-minibus"
    agent: str = "lpv-nmpc"
    agent_settings: Mapping[str, Any] = field(default_factory=dict)
    rate: int = 50
    seconds: float = 60.0
    conditions: str | dict[str, Any] = "realtime"
    estimator: str = "ekf"
    seed: int = 0
    watchdog: int = 25

    def __post_init__(self) -> None:
        if not 1 <= self.rate <= MS_PER_SECOND // 2 or MS_PER_SECOND % self.rate:
            raise ValueError(
                f"--rate must divide {MS_PER_SECOND} (say 10, 20, 25, 50, 100 or 200 Hz), "
                f"not {self.rate}"
            )
        if not self.period <= self.seconds <= 86400.0:
            raise ValueError(
                f"--seconds must be from one control period to a day, not {self.seconds}"
            )
        if self.watchdog < 4:
            raise ValueError(f"--watchdog must be at least 4 periods, not {self.watchdog}")
        choose("estimator", self.estimator, ESTIMATORS)
        check_settings(self.agent, self.agent_settings)
        load(self.conditions)
        trajectories.load(self.trajectory, vehicle=vehicle.load(self.vehicle))

    @property
    def period(self) -> float:
        """Control period, s."""
        return 1.0 / self.rate

    @property
    def period_ms(self) -> int:
        """Control period, ms."""
        return MS_PER_SECOND // self.rate

    @property
    def period_ns(self) -> int:
        """Control period, ns."""
        return self.period_ms * MS

    @property
    def fix_ms(self) -> int:
        """Time between fixes of the position, ms."""
        return max(round(MS_PER_SECOND * self.known_conditions.gnss_period), 1)

    @property
    def tick_ms(self) -> int:
        """Time between the instants at which samples are taken, ms."""
        return math.gcd(self.period_ms, INERTIAL_MS, WHEEL_MS, self.fix_ms)

    @property
    def conditions_name(self) -> str:
        """Conditions in words."""
        if isinstance(self.conditions, str):
            return self.conditions
        return ", ".join(
            f"{value}" if key == "name" else f"{key} {value}"
            for key, value in self.conditions.items()
        )

    @property
    def known_conditions(self) -> Conditions:
        """Conditions as an object, `IDEAL` for the simulation."""
        return load(self.conditions) or IDEAL

    def task_env(self) -> PathTrackingEnv:
        """Return an environment with the path, vehicle, period and known delays.

        It simulates no computing delay: the processes of a run have a real one.
        """
        conditions = load(self.conditions)
        return PathTrackingEnv(
            self.trajectory,
            self.vehicle,
            conditions=conditions.replace(computing_delay=0.0) if conditions else SIMULATION,
            control_period=self.period,
        )
