"""What the three processes tell each other: numpy records, SI units.

Times called `taken` are in ns of `time.monotonic_ns()`, the clock that all processes share: when
the sample was due that a message goes back to. NaN stands for what was not measured.
"""

import numpy as np

SAMPLE = np.dtype(
    [
        ("period", np.int64),  # number of the control period that it belongs to, from 0
        ("taken", np.int64),
        ("time", np.float64),  # s on the vehicle's clock
        ("mean_acceleration", np.float64),  # what the actuators report, over the time since the
        ("mean_steering_angle", np.float64),  # last sample: m/s^2, rad
        ("acceleration", np.float64),  # and what they have in force now
        ("steering_angle", np.float64),
        ("heading", np.float64),  # rad
        ("yaw_rate", np.float64),  # rad/s
        ("speed", np.float64),  # m/s, of the wheels
        ("fix_time", np.float64),  # s on the vehicle's clock: when the position below was true
        ("fix_x", np.float64),  # m
        ("fix_y", np.float64),
        ("truth", np.float64, (6,)),  # [vx, vy, psi, r, X, Y], for `--estimator truth` alone
    ]
)
"""From the vehicle to the estimator."""

ESTIMATE = np.dtype(
    [
        ("period", np.int64),
        ("taken", np.int64),  # of the newest sample in it
        ("time", np.float64),
        ("state", np.float64, (6,)),  # [vx, vy, psi, r, X, Y]
        ("acceleration", np.float64),  # what the actuators had in force then
        ("steering_angle", np.float64),
        ("position_deviation", np.float64),  # m, standard deviation in the worst direction
        ("fix_age", np.float64),  # s since the last fix that was used
        ("steering_offset", np.float64),  # rad: what the wheels stand at beyond what is reported
        ("fixes_used", np.int64),
        ("fixes_refused", np.int64),  # gated, late, duplicate or not finite
        ("readings_refused", np.int64),  # gated or not finite
        ("samples_lost", np.int64),  # written over before they were read
    ]
)
"""From the estimator to the controller (and to the vehicle's report)."""

COMMAND = np.dtype(
    [
        ("period", np.int64),
        ("taken", np.int64),  # of the estimate that it answers
        ("estimated", np.int64),  # when that estimate was written
        ("acceleration", np.float64),  # m/s^2
        ("steering_angle", np.float64),  # rad
        ("solve_time", np.float64),  # s in the agent's `predict`; 0 where it was not asked
        ("reason", np.int64),  # DRIVING, or why the controller brakes
        ("failures", np.int64),  # calls of `predict` that failed, so far
    ]
)
"""From the controller to the vehicle."""

DRIVING, STALE_ESTIMATE, NO_FIX, NOT_FINITE, FAILED = range(5)
REASONS = ("driving", "stale estimate", "no fix", "estimate not finite", "failed solve")
"""Why a command is what it is, by code."""

STALE_PERIODS = 3
"""Control periods after which an estimate, or a command that answers it, is too old to use."""
