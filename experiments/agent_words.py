"""What an agent shows in the picture: its plan in the world, and its solve and weights in words."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weights import in_words
from lpv_track_env.bicycle import PSI, X, Y

Array = NDArray[np.float64]


def world_plan(info: dict[str, Any]) -> Array | None:
    """An agent's predicted positions (n, 2) m in the world, from the foot point's frame.

    The frame belongs to the step that has just been driven: the foot point is found back from the
    plan's own start, which is the vehicle, so the plan is drawn from where the vehicle now is.
    """
    plan = info.get("agent", {}).get("plan")
    if plan is None or len(plan) < 3:
        return None
    state = info["state"]
    heading = state[PSI] - info["heading_error"]
    c, s = math.cos(heading), math.sin(heading)
    ahead = np.asarray(plan)[1:] - np.asarray(plan)[1]
    return np.column_stack(
        [state[X] + c * ahead[:, 0] - s * ahead[:, 1], state[Y] + s * ahead[:, 0] + c * ahead[:, 1]]
    )


def agent_notes(name: str, info: dict[str, Any]) -> dict[str, str]:
    """Words by label: the agent's name, how its last solve went, the weights in use.

    Nothing of it depends on how fast the computer is: equal drives give equal frames.
    """
    notes, told = {"agent": name}, info.get("agent", {})
    if "status" in told:
        count = told["iterations"]
        notes["solver"] = f"{told['status']}, {count} iteration{'' if count == 1 else 's'}"
        # Always a row, so that the card keeps its size.
        notes["fallback"] = told.get("fallback") or "none"
    if told.get("weights") is not None:
        notes |= in_words(told["weights"])
    if info.get("stopping"):
        notes["vehicle"] = "brakes by itself"
    return notes
