"""Plants: what moves under an agent's commands.

The environment's own is the dynamic bicycle of its compiled kernels, `bicycle`: the very model
that the NMPC predicts with. The others are vehicles that nobody here modelled, so that an agent is
also tested on physics that its model does not have:

============  ==========================================================================
name          plant
============  ==========================================================================
bicycle       `lpv_track_env.bicycle` in `lpv_track_env.kernels`
single-track  CommonRoad's single-track model: linear tyres that carry the shifting load
drift         CommonRoad's drift single-track: Pacejka tyres, two spinning wheels
multi-body    CommonRoad's multi-body model: suspension, four tyres, 29 states
============  ==========================================================================

A plant follows `Plant`. Its commands have passed the actuators of the environment, which clip
range and rate alike for every plant.
"""

import importlib
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.vehicle import VehicleParameters
from trajectories.naming import choose

Array = NDArray[np.float64]


class Plant(Protocol):
    """A vehicle's motion over control periods; it keeps its own, possibly larger, state."""

    def begin(self, state: Array, steering_angle: float) -> None:
        """Start an episode.

        Parameters
        ----------
        state
            [vx, vy, psi, r, X, Y] of the centre of gravity, shape (6,).
        steering_angle
            rad, left positive.
        """
        ...

    def advance(self, acceleration: float, steering_angle: float, period: float) -> Array:
        """Drive one control period under a held command.

        Parameters
        ----------
        acceleration
            Command a as in `bicycle`, m/s^2: rolling resistance is still to be taken off.
        steering_angle
            What the steering actuator brings the front wheels to, rad.
        period
            s.

        Returns
        -------
        NDArray
            State as in `begin`, shape (6,), not finite if the model broke down.

        Raises
        ------
        ArithmeticError, ValueError
            If the model cannot be evaluated; the episode then ends as `non_finite`.
        """
        ...


Factory = Callable[[VehicleParameters], Plant]
"""What makes a vehicle's plant: for instance, the plant's class."""

BICYCLE = "bicycle"
"""The plant of the compiled kernels."""

PLANTS: dict[str, str] = {
    "single-track": "lpv_track_env.plants.commonroad:SingleTrack",
    "drift": "lpv_track_env.plants.commonroad:Drift",
    "multi-body": "lpv_track_env.plants.commonroad:MultiBody",
}
"""Class of every other plant, "module:Class", called with a `VehicleParameters`."""


def names() -> tuple[str, ...]:
    """Names of all plants."""
    return (BICYCLE, *PLANTS)


def make(plant: str | Factory, vehicle: VehicleParameters) -> Plant | None:
    """Make a vehicle's plant by its name or by what makes it; None for `bicycle`.

    The bicycle is in the kernels, and stays there.

    Raises
    ------
    ValueError
        For an unknown name (the message lists the known ones and the nearest), or a vehicle that
        the plant has no parameters for.
    ModuleNotFoundError
        If the plant needs a package that is not installed, with how to install it.
    """
    if not isinstance(plant, str):
        return plant(vehicle)
    if choose("plant", plant, names()) == BICYCLE:
        return None
    module, _, attribute = PLANTS[plant].partition(":")
    factory: Factory = getattr(importlib.import_module(module), attribute)
    return factory(vehicle)
