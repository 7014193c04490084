"""Steady turns of the dynamic bicycle: where episodes start, and feedforward of controllers.

With vy' = r' = 0 (`bicycle`) the axles share the lateral force m r vx by lr/L and lf/L, so that
vy = b r with b = lr - m vx^2 lf/(L Car), and the curvature r/sqrt(vx^2 + vy^2) gives the yaw rate
per speed rho = kappa/sqrt(1 - (kappa b)^2). Then::

    delta = rho (b + lf) + rho m vx^2 lr/(L Caf cos(delta))

which for small angles is L kappa + K vx^2 kappa with the understeer gradient K (Rajamani, Vehicle
Dynamics and Control, section 3.3). Nothing is divided by the speed.

Tyres of limited friction (`tyres`) use the same share z = |r vx|/(mu g) of their grip on both axles
and slip by 3 (1 - (1 - z)^(1/3))/z times as much as linear ones: both stiffnesses fall by that.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE
from lpv_track_env.plausibility import GRAVITY
from trajectories.compilation import compiled_internal

MOST_RATIO = 0.75
"""Largest (kappa b)^2, the squared sine of the sideslip: 60 degrees."""
MOST_GRIP = 0.95
"""Largest share z: a turn that needs more is not steady."""


def steady_turn(
    curvature: Any, speed: Any, mass: Any, lf: Any, lr: Any, caf: Any, car: Any, max_steering: Any
) -> tuple[Any, Any, Any]:
    """Return steering angle delta (rad), yaw rate per speed rho (1/m) and b (m) of a steady turn.

    The solution is exact for the bicycle on linear tyres. For Python and compiled code.

    Parameters
    ----------
    curvature
        1/m, signed, of the circle of the centre of gravity; limited to that at full lock and
        standstill.
    speed
        vx, m/s.
    mass, lf, lr, caf, car
        kg, m, m, N/rad, N/rad, as in `vehicle`.
    max_steering
        Largest steering angle, rad.
    """
    wheelbase = lf + lr
    limit = max_steering / wheelbase
    curvature = min(max(curvature, -limit), limit)
    momentum = mass * speed * speed / wheelbase
    lever = lr - momentum * lf / car
    ratio = min((curvature * lever) ** 2, MOST_RATIO)
    turning = curvature / math.sqrt(1.0 - ratio)
    delta = turning * wheelbase
    for _ in range(3):  # a fixed-point iteration that contracts by delta^2 or better
        cosine = math.cos(min(max(delta, -0.8), 0.8))
        delta = turning * (lever + lf + momentum * lr / (caf * cosine))
    return delta, turning, lever


compiled_steady_turn = compiled_internal(steady_turn)


@compiled_internal
def softened(curvature: Any, speed: Any, friction: Any) -> Any:
    """Return the share of the cornering stiffness that a turn leaves, 1 on linear tyres (inf)."""
    z = min(abs(curvature) * speed * speed / (friction * GRAVITY), MOST_GRIP)
    if z < 1e-6:
        return 1.0
    return z / (3.0 * (1.0 - (1.0 - z) ** (1.0 / 3.0)))


@compiled_internal
def turn_steadily(
    record: NDArray[np.float64],
    constants: NDArray[np.float64],
    curvature: Any,
    friction: Any,
    max_steering: Any,
) -> tuple[Any, Any]:
    """Set the lateral motion of a record's state, whose vx is set, to that of a steady turn.

    The heading turns back by the sideslip, so that the vehicle moves along its former direction.
    `constants` are those of `kernels`, `friction` and `max_steering` as in `episodes.begin`.

    Returns the steering angle (rad), and the acceleration (m/s^2) that makes up for what the turn
    takes from the speed.
    """
    speed, mass, lf, lr = record[VX], constants[0], constants[2], constants[3]
    if friction < math.inf and abs(curvature) * speed * speed > MOST_GRIP * friction * GRAVITY:
        curvature = math.copysign(MOST_GRIP * friction * GRAVITY / (speed * speed), curvature)
    share = softened(curvature, speed, friction)
    delta, turning, lever = compiled_steady_turn(
        curvature, speed, mass, lf, lr, share * constants[4], share * constants[5], max_steering
    )
    delta = min(max(delta, -max_steering), max_steering)
    record[YAW_RATE] = turning * speed
    record[VY] = lever * record[YAW_RATE]
    record[PSI] -= math.atan(turning * lever)
    centripetal = record[YAW_RATE] * speed
    return delta, centripetal * lr / (lf + lr) * math.tan(delta) - record[VY] * record[YAW_RATE]
