"""Whether what was made for one task drives in another."""

import math
import warnings
from collections.abc import Mapping
from typing import Any, Protocol

from agents.base import DrivingTask
from lpv_track_env.observation import ObservationLayout


class MadeForTask(Protocol):
    """What was made, by learning or search, for observations and a control period."""

    @property
    def layout(self) -> ObservationLayout:
        """Observations that it sees."""
        ...

    @property
    def control_period(self) -> float:
        """Seconds between its actions."""
        ...

    @property
    def training(self) -> Mapping[str, Any]:
        """Where it comes from; "vehicle" in it is the name of the one that was driven."""
        ...


def check_task(name: str, made: MadeForTask, task: DrivingTask, *, stacklevel: int = 3) -> None:
    """Refuse what was made for other observations or another control period than the task's.

    For another vehicle it warns, `stacklevel` as in `warnings.warn`.

    Raises
    ------
    ValueError
        Naming it and the difference.
    """
    seen, here = made.layout, task.layout
    same_layout = seen.preview_steps == here.preview_steps and math.isclose(
        seen.preview_period, here.preview_period, rel_tol=1e-9
    )
    same_period = math.isclose(made.control_period, task.control_period, rel_tol=1e-9)
    layout = f"preview_steps={seen.preview_steps}, preview_period={seen.preview_period:g}"
    period = f"control_period={made.control_period:g}"
    if not same_layout:
        wanted = layout if same_period else f"{layout}, {period}"
        raise ValueError(
            f"{name} sees {layout} s; this environment has {here.preview_steps} and "
            f"{here.preview_period:g}: make the environment with {wanted}, or train one for it"
        )
    if not same_period:
        raise ValueError(
            f"{name} acts every {made.control_period:g} s, this environment every "
            f"{task.control_period:g}: make the environment with {period}, or train one for it"
        )
    trained = made.training.get("vehicle")
    if isinstance(trained, str) and trained != task.vehicle.name:
        warnings.warn(
            f"{name} was trained for vehicle {trained!r}, not for {task.vehicle.name!r}",
            UserWarning,
            stacklevel=stacklevel,
        )
