"""What a parallel run is made of, the same for all its processes."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import agents
import trajectories
from agents.registry import check_settings
from lpv_track_env import vehicle
from lpv_track_env.conditions import IDEAL, Conditions, load
from lpv_track_env.env import PathTrackingEnv
from trajectories.naming import choose

MS = 1_000_000
"""ns."""
MS_PER_SECOND = 1000
STEP = 1.0 / MS_PER_SECOND
"""s: the simulated vehicle's cycle, in which it is integrated and commands take effect."""
INERTIAL_MS, WHEEL_MS = 10, 20
"""Time between readings, ms: IMU and heading at 100 Hz, wheels at 50 Hz. Fixes: see conditions."""
PREVIEW_PERIOD, PREVIEW_STEPS = 0.05, 20
"""s and nodes: agents look one second ahead, whatever the rate."""
ESTIMATORS = ("ekf", "truth")


def undelayed(conditions: Conditions) -> Conditions:
    """Conditions without the computing delay that the processes of a run really have."""
    return conditions.replace(computing_delay=0.0)


@dataclass(frozen=True)
class Setup:
    """A run's settings; it is handed to the processes.

    Parameters
    ----------
    trajectory, vehicle, agent, agent_settings
        As in the other commands.
    rate
        Control rate, Hz; a divisor of 1000.
    seconds
        Length of the run, s; it ends before that where the path does.
    conditions
        Of sensors, actuators and vehicle: what `lpv_track_env.conditions.load` knows.
    estimator
        "ekf", or "truth": what the vehicle really does is passed on as the estimate.
    seed
        Of the sensors' noise.
    watchdog
        Control periods without a new command after which the silent process is taken for hung.

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
        vehicle.load(self.vehicle)
        load(self.conditions)
        trajectories.load(self.trajectory)

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
        """The conditions in words."""
        if isinstance(self.conditions, str):
            return self.conditions
        return ", ".join(
            f"{value}" if key == "name" else f"{key} {value}"
            for key, value in self.conditions.items()
        )

    @property
    def known_conditions(self) -> Conditions:
        """The conditions themselves."""
        return load(self.conditions) or IDEAL

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    def task_env(self) -> PathTrackingEnv:
        """What an agent is made for: path, vehicle, control period, preview, known delays."""
        conditions = load(self.conditions)
        return PathTrackingEnv(
            self.trajectory,
            self.vehicle,
            # Computing takes the time that it really takes, which is next to nothing.
            conditions="simulation" if conditions is None else undelayed(conditions),
            control_period=self.period,
            preview_steps=PREVIEW_STEPS,
            preview_period=PREVIEW_PERIOD,
        )

    def make_agent(self, env: PathTrackingEnv) -> agents.Agent:
        """The agent that drives."""
        return agents.make(self.agent, env, **self.agent_settings)
