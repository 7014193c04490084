"""Observations of a path from states of other sources: estimates, logs, other simulations."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lpv_track_env import kernels
from lpv_track_env.bicycle import X, Y
from lpv_track_env.observation import ObservationLayout
from trajectories import ReferencePath
from trajectories.projection import SEARCH_WINDOW, tightest_turn

Array = NDArray[np.float64]


class PathObserver:
    """Compute the observations that the environments would return for given states.

    Parameters
    ----------
    path
        Reference path.
    layout
        Layout of the observation, the same as the agent's.
    table
        Table whose speeds the preview shows, (n, 8); by default the path's own.

    Examples
    --------
    >>> observer = PathObserver(trajectories.load("T2"), ObservationLayout())
    >>> observer.begin(state)
    >>> action, _ = agent.predict(observer.observe(state, acceleration, steering_angle))
    """

    def __init__(
        self, path: ReferencePath, layout: ObservationLayout, table: Array | None = None
    ) -> None:
        self.path, self.layout = path, layout
        self._table = path.table if table is None else table
        self._record = np.zeros(kernels.RECORD_SIZE)
        self._observation = np.zeros(layout.size, dtype=np.float32)
        self._constants = np.zeros(kernels.CONSTANTS_SIZE)
        self._constants[kernels.LENGTH] = path.length
        self._constants[kernels.CLOSED] = float(path.closed)
        self._constants[kernels.TIGHTEST] = tightest_turn(path.table, path.closed)
        self._constants[kernels.PREVIEW_PERIOD] = layout.preview_period

    def begin(self, state: ArrayLike, near: float | None = None) -> None:
        """Begin at the foot point nearest to a state (6,), or to the arc length `near` (m)."""
        values = np.asarray(state, dtype=np.float64)
        foot = self.path.project(float(values[X]), float(values[Y]), near=near)
        self._record[kernels.ARC_LENGTH] = foot.arc_length

    def observe(
        self, state: ArrayLike, acceleration: float, steering_angle: float, ahead: float = 0.0
    ) -> NDArray[np.float32]:
        """Return the observation (size,) of a state (6,) and the actuators (m/s^2, rad).

        The foot point is searched about `ahead` m after the last one, hence on the same branch of
        the path.
        """
        self._record[:6] = state
        self._record[kernels.ACCELERATION] = acceleration
        self._record[kernels.STEERING] = steering_angle
        window = min(max(SEARCH_WINDOW, 1.5 * abs(ahead)), self.path.length)
        kernels.locate_and_observe(
            self._record, self._constants, self._table, self._observation, ahead, window
        )
        return self._observation.copy()

    @property
    def state(self) -> Array:
        """Last state [vx, vy, psi, r, X, Y], (6,), a copy."""
        return self._record[:6].copy()

    @property
    def arc_length(self) -> float:
        """Arc length of the last foot point, m; on a closed path it increases over laps."""
        return float(self._record[kernels.ARC_LENGTH])

    @property
    def lateral_error(self) -> float:
        """Lateral error of the last state, m, left positive."""
        return float(self._record[kernels.LATERAL_ERROR])

    @property
    def heading_error(self) -> float:
        """Heading error of the last state, rad."""
        return float(self._record[kernels.HEADING_ERROR])

    @property
    def speed_error(self) -> float:
        """Speed of the last state minus that of the reference, m/s."""
        return float(self._record[kernels.SPEED_ERROR])
