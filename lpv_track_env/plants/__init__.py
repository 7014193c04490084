"""Plants: the models that an environment simulates under an agent's commands.

The default is `bicycle`, the dynamic bicycle of the compiled kernels, with which the NMPC predicts,
too. The others are independent models of other authors: they test an agent on physics that its own
model does not contain.

============  ==========================================================================
name          plant
============  ==========================================================================
bicycle       `lpv_track_env.bicycle` in `lpv_track_env.kernels`
single-track  CommonRoad's single-track model: linear tyres that carry the shifting load
drift         CommonRoad's drift single-track: Pacejka tyres, two spinning wheels
multi-body    CommonRoad's multi-body model: suspension, four tyres, 29 states
============  ==========================================================================

A plant implements `Plant`. It receives the commands after the actuators of the environment, which
clip range and rate in the same way for every plant.
"""

import importlib
import math
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lpv_track_env import kernels
from lpv_track_env.conditions import Conditions
from lpv_track_env.conditions import episode as conditions_episode
from lpv_track_env.conditions.layout import FRICTION, STRETCH_FACTOR, ConditionedVehicle
from lpv_track_env.conditions.vehicle import slipperiness
from lpv_track_env.vehicle import VehicleParameters
from trajectories.naming import choose

Array = NDArray[np.float64]


class Plant(Protocol):
    """Model of a vehicle's motion over control periods; it keeps a state of its own."""

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
            Command a as in `bicycle`, m/s^2, before rolling resistance.
        steering_angle
            Angle of the front wheels after the steering actuator, rad.
        period
            s.

        Returns
        -------
        NDArray
            State as in `begin`, shape (6,); not finite if the model broke down.

        Raises
        ------
        ArithmeticError, ValueError
            If the model cannot be evaluated; the episode then ends as `non_finite`.
        """
        ...


@runtime_checkable
class RoadPlant(Plant, Protocol):
    """A plant that takes the friction of the conditions: that of its road, by its own."""

    friction: float
    """Largest side force by load on the plant's own road."""

    def set_friction(self, factor: float) -> None:
        """Multiply the road's own friction from the next period on; 1 is the plant's own road."""
        ...


Factory = Callable[[VehicleParameters], Plant]
"""A function that makes the plant of a vehicle, for instance the plant's class."""

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
    """Make a vehicle's plant by its name or factory; None for `bicycle`, which the kernels contain.

    Raises
    ------
    ValueError
        For an unknown name (the message lists the known ones and the nearest), or a vehicle for
        which the plant has no parameters.
    ModuleNotFoundError
        If the plant needs a package that is not installed; the message says how to install it.
    """
    if callable(plant):
        return plant(vehicle)
    if choose("plant", plant, names()) == BICYCLE:
        return None
    module, _, attribute = PLANTS[plant].partition(":")
    factory: Factory = getattr(importlib.import_module(module), attribute)
    return factory(vehicle)


def episode_of(plant: str | Factory, vehicle: VehicleParameters) -> "PlantEpisode | None":
    """Make a vehicle's plant for an environment; None for `bicycle`. Errors as in `make`."""
    made = make(plant, vehicle)
    return None if made is None else PlantEpisode(made)


def friction_range(
    plant: "PlantEpisode | None", conditions: Conditions | None
) -> tuple[float, float]:
    """Return the least and largest friction of tyres and road, inf without a limit."""
    given = (math.inf,) * 2 if conditions is None else conditions.ends("friction")
    return given if plant is None else plant.friction_range(*given)


def road_friction(
    plant: "PlantEpisode | None",
    conditioned: ConditionedVehicle | None,
    record: Array,
    constants: Array,
) -> float:
    """Return the friction of tyres and road where a vehicle is, as drawn; inf without a limit."""
    drawn, factor = math.inf, 1.0
    if conditioned is not None:
        drawn = float(conditioned.vehicle[FRICTION])
        factor = float(slipperiness(record, conditioned.spec, constants))
    return factor * (drawn if plant is None else plant.friction_range(drawn, drawn)[0])


class PlantEpisode:
    """Control periods of an environment whose plant is not the kernels' bicycle.

    The kernels still compute the actuators before the plant, and errors, reward and end of the
    episode after it.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant

    def friction_range(self, low: float, high: float) -> tuple[float, float]:
        """Return the largest side forces by load for ends of the conditions' friction.

        They are inf if unknown.
        """
        if not isinstance(self.plant, RoadPlant):
            return math.inf, math.inf
        own = self.plant.friction
        return own * (low if low < math.inf else 1.0), own * (high if high < math.inf else 1.0)

    def begin(self, record: Array, friction: float = math.inf) -> None:
        """Start the plant at the state and steering angle of an episode's record.

        `friction` multiplies that of the plant's road; inf leaves it.
        """
        self._set_friction(friction)
        self.plant.begin(record[:6].copy(), float(record[kernels.STEERING]))

    def _set_friction(self, friction: float, factor: float = 1.0) -> None:
        if isinstance(self.plant, RoadPlant):
            self.plant.set_friction(factor * (friction if friction < math.inf else 1.0))

    def advance(self, episode: Array, table: Array, *conditioned: Any) -> tuple[float, ...]:
        """Drive one control period in place of `kernels.advance`, with its arguments and result.

        Under conditions these are the arguments of `advance_under_conditions`. Conditions of
        sensors, actuators and commands hold for every plant, but mass, tyres and wind are the
        plant's own, up to a `RoadPlant`'s friction.
        """
        end = kernels.NOT_FINITE
        if math.isfinite(episode[0]) and math.isfinite(episode[1]):
            if conditioned:
                vehicle, spec = conditioned[:2]
                if spec[STRETCH_FACTOR] != 1.0:
                    record = episode[kernels.RECORD : kernels.CONSTANTS]
                    constants = episode[kernels.CONSTANTS : kernels.OBSERVATION]
                    factor = slipperiness(record, spec, constants)
                    self._set_friction(float(vehicle[FRICTION]), float(factor))
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
        results = episode[kernels.RECORD : kernels.CONSTANTS].tolist()[kernels.ARC_LENGTH :]
        clipped = kernels.CLIPPED - kernels.ARC_LENGTH
        return end, *results[:clipped], int(results[clipped]), *results[clipped + 1 :]
