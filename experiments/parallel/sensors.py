"""The simulated vehicle's sensors, each at its own rate, with the noise of some conditions."""

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.parallel.setup import INERTIAL_MS, MS_PER_SECOND, WHEEL_MS
from lpv_track_env.bicycle import PSI, VX, YAW_RATE, X, Y
from lpv_track_env.conditions import IDEAL, Conditions

Array = NDArray[np.float64]


class Sensors:
    """Readings of a vehicle's true state.

    Errors are modelled as `lpv_track_env.conditions.Conditions` describes them, ranges drawn once.

    Parameters
    ----------
    conditions
        None: perfect sensors.
    fix_ms
        Time between fixes, ms.
    seed
        Of all draws.
    """

    def __init__(self, conditions: Conditions | None, fix_ms: int, seed: int) -> None:
        self.conditions = conditions or IDEAL
        self._random = np.random.default_rng(seed)
        drawn = {
            name: self._random.uniform(*self.conditions.ends(name))
            for name in (
                "gnss_latency", "gnss_noise", "gnss_wander", "gnss_wander_time",
                "gnss_dropout_rate", "gnss_outlier_rate", "gnss_outlier_size", "heading_noise",
                "heading_bias", "yaw_rate_noise", "yaw_rate_bias", "yaw_rate_drift",
                "speed_noise", "speed_scale",
            )
        }  # fmt: skip
        self._drawn = drawn
        self._fix_ms = fix_ms
        self._wander = drawn["gnss_wander"] * self._random.standard_normal(2)
        self._yaw_rate_bias = drawn["yaw_rate_bias"]
        self._outage_until = -math.inf
        self._coming: deque[tuple[int, float, float, float]] = deque()
        """Fixes on their way: when they arrive (ms), their stamp (s), x and y (m)."""

    def read(self, ms: int, state: Array, record: Any) -> None:
        """Write into a SAMPLE record what is read at `ms` of the vehicle's clock; NaN: nothing."""
        drawn, noise = self._drawn, self._random.standard_normal
        for name in ("heading", "yaw_rate", "speed", "fix_time", "fix_x", "fix_y"):
            record[name] = math.nan
        if ms % INERTIAL_MS == 0:
            self._yaw_rate_bias += (
                drawn["yaw_rate_drift"] * math.sqrt(INERTIAL_MS / MS_PER_SECOND) * noise()
            )
            error = drawn["heading_bias"] + drawn["heading_noise"] * noise()
            record["heading"] = state[PSI] + error
            error = self._yaw_rate_bias + drawn["yaw_rate_noise"] * noise()
            record["yaw_rate"] = state[YAW_RATE] + error
        if ms % WHEEL_MS == 0:
            scale = 1.0 + drawn["speed_scale"]
            record["speed"] = scale * state[VX] + drawn["speed_noise"] * noise()
        if ms % self._fix_ms == 0:
            self._measure_fix(ms, state)
        if self._coming and self._coming[0][0] <= ms:
            _, record["fix_time"], record["fix_x"], record["fix_y"] = self._coming.popleft()

    def _measure_fix(self, ms: int, state: Array) -> None:
        """A fix of this moment, if there is one, on its way; the first one is there at once."""
        drawn, noise = self._drawn, self._random.standard_normal
        time, between = ms / MS_PER_SECOND, self._fix_ms / MS_PER_SECOND
        keep = math.exp(-between / drawn["gnss_wander_time"])
        fresh = drawn["gnss_wander"] * math.sqrt(1.0 - keep * keep)
        self._wander = keep * self._wander + fresh * noise(2)
        first = ms == 0
        if time >= self._outage_until and not first:
            chance = -math.expm1(-between * drawn["gnss_dropout_rate"])
            if self._random.uniform() < chance:
                lasts = self._random.uniform(*self.conditions.ends("gnss_dropout_duration"))
                self._outage_until = time + lasts
        if time < self._outage_until:
            return
        x, y = state[[X, Y]] + self._wander + drawn["gnss_noise"] * noise(2)
        if not first and self._random.uniform() < drawn["gnss_outlier_rate"]:
            direction = self._random.uniform(-math.pi, math.pi)
            x += drawn["gnss_outlier_size"] * math.cos(direction)
            y += drawn["gnss_outlier_size"] * math.sin(direction)
        arrives = ms if first else ms + math.ceil(MS_PER_SECOND * drawn["gnss_latency"] - 1e-6)
        self._coming.append((arrives, time, float(x), float(y)))
