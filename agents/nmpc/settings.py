"""Settings that the NMPC agents share, checked in one place."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from agents.weights import TrackingWeights, WeightSchedule, weights_from
from lpv_track_env.vehicle import VehicleParameters

Function = TypeVar("Function", bound=Callable[..., None])


@dataclass(frozen=True, kw_only=True)
class NmpcSettings:
    """Settings of an NMPC agent.

    Parameters
    ----------
    horizon
        Horizon N, at most the preview steps of the observation (the default).
    weights
        Fixed weights, a schedule, or the file of a schedule. Either may be given as a mapping, too:
        `{"Q": [4 numbers], "S": [4], "R": [2]}`, or a schedule in the form of its file. Once the
        settings are made, these are `TrackingWeights` or a `WeightSchedule`.
    selection
        Rule by which a schedule chooses: "band" from the sharpest curvature in the preview at every
        step, or "path" once from the path's sharpest curvature, the paper's rule.
    model
        Prediction model and its constraints, by default the task's own vehicle.
    linear_penalty, quadratic_penalty
        Penalties of slack on (vx, vy, vx'), see `NmpcProblem`.
    max_failures
        Failed solves in a row after which the vehicle is brought to a stop.

    Raises
    ------
    ValueError
        For an unknown selection, weights that cannot be used, or a file that cannot be read.
    """

    horizon: int | None = None
    weights: TrackingWeights | WeightSchedule | Mapping[str, Any] | str | Path | None = None
    selection: str = "band"
    model: VehicleParameters | None = None
    linear_penalty: tuple[float, float, float] = (20.0, 20.0, 20.0)
    quadratic_penalty: tuple[float, float, float] = (100.0, 100.0, 100.0)
    max_failures: int = 10

    def __post_init__(self) -> None:
        if self.selection not in {"band", "path"}:
            raise ValueError(f"selection must be 'band' or 'path', not {self.selection!r}")
        weights = TrackingWeights() if self.weights is None else weights_from(self.weights)
        object.__setattr__(self, "weights", weights)


def passes_settings(target: Callable[..., Any], *left_out: str) -> Callable[[Function], Function]:
    """Decorate an `__init__` that passes its `**settings` on to `target`.

    Its signature then lists the keyword settings of `target` one by one, except those `left_out`,
    so that a misspelt setting can be named.
    """

    def decorate(function: Function) -> Function:
        own = inspect.signature(function)
        parameters = {
            name: parameter
            for name, parameter in own.parameters.items()
            if parameter.kind is not parameter.VAR_KEYWORD
        }
        for name, parameter in inspect.signature(target).parameters.items():
            if parameter.kind is parameter.KEYWORD_ONLY and name not in left_out:
                parameters.setdefault(name, parameter)
        function.__signature__ = own.replace(parameters=list(parameters.values()))  # type: ignore[attr-defined]
        return function

    return decorate
