"""One control period of a single environment whose plant is not the kernels' bicycle."""

import math

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.plants import Plant

Array = NDArray[np.float64]


class PlantEpisode:
    """In place of `kernels.advance`: actuators and the period's end are the kernels', too.

    Parameters
    ----------
    plant
        What moves between them.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant

    def begin(self, memory: Array) -> None:
        """Take over the state and the steering angle that an episode begins with."""
        self.plant.begin(memory[:6].copy(), float(memory[kernels.STEERING]))

    def advance(self, episode: Array, table: Array) -> tuple[float, ...]:
        """Drive one control period in place: arguments and result as of `kernels.advance`."""
        end = kernels.NOT_FINITE
        if math.isfinite(episode[0]) and math.isfinite(episode[1]):
            a, delta, bits = kernels.command(episode)
            period = float(episode[kernels.CONSTANTS + kernels.PERIOD])
            try:
                state = self.plant.advance(a, delta, period)
            except (ArithmeticError, ValueError):
                state = np.full(6, np.nan)
            vx, vy, psi, r, x, y = state.tolist()
            end = kernels.conclude(episode, table, vx, vy, psi, r, x, y, a, delta, bits)
        told = episode[kernels.MEMORY : kernels.CONSTANTS].tolist()[kernels.ARC_LENGTH :]
        clipped = kernels.CLIPPED - kernels.ARC_LENGTH
        return end, *told[:clipped], int(told[clipped]), *told[clipped + 1 :]
