"""Speeds of a previewed reference that friction allows, for compiled code.

A reference planned for more grip than there is sends a vehicle off the road at the first bend, and
no controller can help that: speed must come off before the bend. The preview's speeds are therefore
capped by a backward pass, which brakes in time, and a forward pass, which accelerates again.
"""

import math
from typing import Any

from numpy.typing import NDArray

from trajectories.compilation import compiled_internal

Array = NDArray[Any]

SHARE = 0.8
"""Share of a vehicle's largest acceleration and deceleration that a reference takes: less than all,
so that it can catch up."""
GRIP_SHARE = 0.88
"""Share of mu g that a reference takes at most."""
BRAKING_SHARE = 0.6
"""Share of that by which it slows down."""


@compiled_internal
def exceeds(
    curvature: Array, first_speed: Any, speed: Array, period: Any, steps: int, grip: Any
) -> bool:
    """Return whether the acceleration of a preview exceeds `grip` (m/s^2) in its first `steps`."""
    before, largest = first_speed, 0.0
    for k in range(steps):
        after = float(speed[k])
        fastest = max(before, after)
        turning, gain = fastest * fastest * float(curvature[k]), (after - before) / period
        largest = max(largest, turning * turning + gain * gain)
        before = after
    return bool(largest > grip * grip)


@compiled_internal
def remaining_grip(turning: Any, grip: Any) -> Any:
    """Return the acceleration that a lateral one leaves within the friction circle, m/s^2."""
    return math.sqrt(max(grip * grip - turning * turning, 0.0))


@compiled_internal
def cap_speeds(
    curvature: Array, first_speed: Any, speed: Array, period: Any, pace: Any, rate: Any, grip: Any,
    braking: Any, capped: Array,
) -> bool:  # fmt: skip
    """Fill the speeds (n + 1,) at which friction lets a vehicle pass the preview's first nodes.

    Returns False, with nothing filled, if the preview is slow enough.

    No node is passed faster than in the preview, and no total acceleration exceeds `grip` (m/s^2):
    bends are taken more slowly, and the rest of the friction circle serves to brake before them and
    to accelerate behind them. The largest deceleration is the preview's own or, if that is larger,
    `SHARE` of `braking`, at most `BRAKING_SHARE` of the grip; the largest acceleration is the
    preview's own or `SHARE` of `rate` (m/s^2). If the vehicle is already too fast, at `pace` (m/s),
    the speeds begin there and fall with the deceleration of `braking` and grip.
    """
    steps, squared, bend, after = capped.shape[0] - 1, math.inf, 0.0, 0.0
    if not exceeds(curvature, first_speed, speed, period, steps, grip):
        return False
    slowed = min(SHARE * braking, BRAKING_SHARE * grip) * period
    # Backwards with squares of speeds, from node to node, each with the interval behind it.
    for k in range(steps, -1, -1):
        before, curve = first_speed, 0.0
        if k > 0:
            before, curve = float(speed[k - 1]), abs(float(curvature[k - 1]))
        if k < steps:
            lost = min(max(before - after, slowed), period * remaining_grip(squared * bend, grip))
            squared += lost * (before + after)
        squared = min(squared, before * before)
        if squared * max(bend, curve) > grip:
            squared = grip / max(bend, curve)
        capped[k], after, bend = squared, before, curve
    before, least = first_speed, max(pace, 0.0) ** 2
    for k in range(steps + 1):
        capped[k] = min(max(capped[k], least), before * before)
        if k < steps:
            after = float(speed[k])
            left = period * remaining_grip(capped[k] * abs(float(curvature[k])), grip)
            gained = min(max(after - before, SHARE * rate * period), left)
            capped[k + 1] = min(capped[k + 1], capped[k] + gained * (before + after))
            least -= slowed * (before + after)
            before = after
        capped[k] = math.sqrt(capped[k])
    return True


@compiled_internal
def capped_interval(
    first_speed: Any, speed: Array, period: Any, capped: Array, k: int
) -> tuple[Any, Any]:
    """Return the end speed (m/s) of interval k, and the time (s) that it takes, with `cap_speeds`.

    Intervals without capped speeds keep the preview's.
    """
    end = float(speed[k])
    if k + 1 >= capped.shape[0]:
        return end, period
    before = float(speed[k - 1]) if k > 0 else first_speed
    slow = capped[k] + capped[k + 1]
    if slow == before + end:
        return end, period
    return capped[k + 1], (before + end) * period / slow
