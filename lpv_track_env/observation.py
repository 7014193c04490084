"""The observation contract, the same for every agent, model-based or learned.

A flat float32 vector in the frames of the vehicle and of the path, so that nothing wraps:

====================  =======  ==========================================================
entry                 unit     meaning
====================  =======  ==========================================================
longitudinal_speed    m/s      vx, body frame
lateral_speed         m/s      vy, body frame, left positive
yaw_rate              rad/s    r, counter-clockwise
acceleration          m/s^2    acceleration command in force at the actuator
steering_angle        rad      steering angle in force at the actuator, left positive
lateral_error         m        offset from the path's foot point, positive left of the path
heading_error         rad      psi minus the path's heading at the foot point, in (-pi, pi]
reference_speed       m/s      the reference's speed at the foot point
preview_curvature     1/m      (K,) mean signed curvature over each of the next K periods
preview_speed         m/s      (K,) reference speed at the end of each of these periods
====================  =======  ==========================================================

The preview is spaced in the reference's own time: node k is the reference's position k preview
periods after the foot point. Interval k is about (speed at k + speed at k + 1) / 2 times the period
long and turns the heading by exactly that length times `preview_curvature[k]`. An agent can
therefore rebuild the reference in the frame of the foot point from the vector alone.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories.arguments import Number, Whole, check_fields

SCALARS = (
    ("longitudinal_speed", "m/s", 100.0),
    ("lateral_speed", "m/s", 100.0),
    ("yaw_rate", "rad/s", 100.0),
    ("acceleration", "m/s^2", 50.0),
    ("steering_angle", "rad", 1.6),
    ("lateral_error", "m", 1000.0),
    ("heading_error", "rad", 3.1415928),
    ("reference_speed", "m/s", 100.0),
)
"""Name, unit and bound of each scalar entry; values beyond a bound saturate at it."""

# Index of each scalar entry, and of the first entry of the preview: curvatures, then speeds.
(
    LONGITUDINAL_SPEED, LATERAL_SPEED, YAW_RATE, ACCELERATION, STEERING_ANGLE, LATERAL_ERROR,
    HEADING_ERROR, REFERENCE_SPEED, PREVIEW_START,
) = range(9)  # fmt: skip

PREVIEW_BOUNDS = (("preview_curvature", "1/m", 20.0), ("preview_speed", "m/s", 100.0))

MIRRORED = (
    "lateral_speed", "yaw_rate", "steering_angle", "lateral_error", "heading_error",
    "preview_curvature",
)  # fmt: skip
"""Entries that change sign when left and right are exchanged."""

Array = NDArray[np.float64]


class TrackingObservation(NamedTuple):
    """Parts of a flat observation, float64: scalars (...), previews (..., K)."""

    longitudinal_speed: Array
    lateral_speed: Array
    yaw_rate: Array
    acceleration: Array
    steering_angle: Array
    lateral_error: Array
    heading_error: Array
    reference_speed: Array
    preview_curvature: Array
    preview_speed: Array


PREVIEW_STEPS, PREVIEW_PERIOD = 20, 0.1
"""Preview by default, whatever the control period: two seconds (s between nodes)."""
MOST_STEPS = 1000
"""Largest number of preview nodes; every step of an environment computes all of them."""
RULES: dict[str, Number | Whole] = {
    "preview_steps": Whole(1, MOST_STEPS),
    "preview_period": Number(0.0, 10.0, "s", above=True),
}


@dataclass(frozen=True)
class ObservationLayout:
    """Names, units, slices and bounds of the observation vector.

    Parameters
    ----------
    preview_steps
        K, number of preview nodes.
    preview_period
        s between preview nodes.

    Raises
    ------
    ValueError
        If there is no preview node or there are more than `MOST_STEPS`, or the period is out of
        range.
    """

    preview_steps: int = PREVIEW_STEPS
    preview_period: float = PREVIEW_PERIOD

    def __post_init__(self) -> None:
        check_fields(self, RULES)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return PREVIEW_START + 2 * self.preview_steps

    @property
    def slices(self) -> dict[str, slice]:
        """Place of each named entry in the vector."""
        scalars = {name: slice(k, k + 1) for k, (name, _, _) in enumerate(SCALARS)}
        first, k = PREVIEW_START, self.preview_steps
        return {
            **scalars,
            "preview_curvature": slice(first, first + k),
            "preview_speed": slice(first + k, first + 2 * k),
        }

    @property
    def bound(self) -> NDArray[np.float32]:
        """Symmetric bound of each entry, shape (size,)."""
        scalars = [bound for _, _, bound in SCALARS]
        previews = [bound for _, _, bound in PREVIEW_BOUNDS for _ in range(self.preview_steps)]
        return np.array(scalars + previews, dtype=np.float32)

    @property
    def mirror(self) -> NDArray[np.float32]:
        """Factor of each entry when left and right are exchanged: 1 or -1, shape (size,)."""
        signs = np.ones(self.size, dtype=np.float32)
        for name in MIRRORED:
            signs[self.slices[name]] = -1.0
        return signs

    @property
    def digest(self) -> str:
        """Short hash of names, units and sizes, which a policy is bound to."""
        parts = [*SCALARS, *PREVIEW_BOUNDS, self.preview_steps, float(self.preview_period)]
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    def tracking_part(self, observation: Any) -> NDArray[np.float32]:
        """Return the tracking observation (..., size) from an observation with further parts.

        `observation` is a dictionary with the entry `tracking`, or a vector, or rows of vectors,
        that begin with it.
        """
        if isinstance(observation, Mapping):
            observation = observation["tracking"]
        return np.asarray(observation)[..., : self.size]

    def unpack(self, observation: ArrayLike) -> TrackingObservation:
        """Split a vector (size,) or a batch (n, size) into its parts.

        Raises
        ------
        ValueError
            If the last dimension is not `size`.
        """
        values = np.asarray(observation, dtype=np.float64)
        if values.shape[-1:] != (self.size,):
            raise ValueError(
                f"observation has shape {values.shape}, this layout has {self.size} entries "
                f"({self.preview_steps} preview steps): make the agent for this environment"
            )
        first, k = PREVIEW_START, self.preview_steps
        scalars = [values[..., index] for index in range(first)]
        previews = [values[..., first : first + k], values[..., first + k :]]
        return TrackingObservation._make(scalars + previews)
