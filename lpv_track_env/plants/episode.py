"""One control period of a single environment whose plant is not the kernels' bicycle."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.conditions import episode as conditions_episode
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

    def begin(self, record: Array) -> None:
        """Take over the state and the steering angle that an episode begins with."""
        self.plant.begin(record[:6].copy(), float(record[kernels.STEERING]))

    def advance(self, episode: Array, table: Array, *conditioned: Any) -> tuple[float, ...]:
        """Drive one control period in place: arguments and result as of `kernels.advance`.

        Under conditions, with those of `advance_under_conditions`: what they do to sensors,
        actuators and commands holds for every plant; mass, tyres and wind are the plant's own.
        """
        end = kernels.NOT_FINITE
        if math.isfinite(episode[0]) and math.isfinite(episode[1]):
            if conditioned:
                vehicle, spec = conditioned[:2]
                a, delta, bits = conditions_episode.command_under_conditions(episode, vehicle, spec)
            else:
                a, delta, bits = kernels.command(episode)
            period = float(episode[kernels.CONSTANTS + kernels.PERIOD])
            try:
                state = np.asarray(self.plant.advance(a, delta, period), dtype=np.float64)
            except (ArithmeticError, ValueError):
                state = np.full(6, np.nan)
            if conditioned:
                given: Any = (episode, table, *conditioned, state, bits)
                end = conditions_episode.conclude_under_conditions(*given)
            else:
                vx, vy, psi, r, x, y = state.tolist()
                end = kernels.conclude(episode, table, vx, vy, psi, r, x, y, a, delta, bits)
        told = episode[kernels.RECORD : kernels.CONSTANTS].tolist()[kernels.ARC_LENGTH :]
        clipped = kernels.CLIPPED - kernels.ARC_LENGTH
        return end, *told[:clipped], int(told[clipped]), *told[clipped + 1 :]
