"""Cost of making a learned policy, which results and tables show beside what it achieves."""

from collections.abc import Mapping, Sequence
from typing import Any

from agents import Agent
from agents.learned.policy import Policy

KINDS: Mapping[str, tuple[type, ...]] = {
    "steps": (int,),
    "seconds": (int, float),
    "solves": (int,),
    "command": (str,),
}
"""Entries kept of a policy's `training`: environment steps, wall time (s), NMPC solves, command."""
AVERAGED = ("steps", "seconds", "solves")
UNKNOWN = "not recorded"


def of_agent(agent: Agent) -> dict[str, Any]:
    """Return `{"training": {...}}` for an agent that runs a learned policy, {} for every other.

    The entry holds `algorithm`, those of `KINDS` that the policy's `training` has, and its `seed`.
    Agents without a policy were designed by hand, at a cost that nobody recorded.
    """
    policy = getattr(agent, "policy", None)  # delay compensation forwards it
    if not isinstance(policy, Policy):
        return {}
    known = {
        key: policy.training[key]
        for key, kinds in KINDS.items()
        if type(policy.training.get(key)) in kinds
    }
    settings = policy.training.get("settings")
    if isinstance(settings, Mapping) and type(settings.get("seed")) is int:
        known["seed"] = settings["seed"]
    return {"training": {"algorithm": policy.algorithm, **known}}


def average(trainings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean cost of trainings, of each quantity over those that recorded it."""
    found = {}
    for key in AVERAGED:
        known = [training[key] for training in trainings if key in training]
        if known:
            found[key] = round(sum(known) / len(known))
    return found


def words(training: Mapping[str, Any]) -> str:
    """Return a summary such as "18.4 M steps, 6 min, 0 solves", without what is not known."""
    parts = []
    if "steps" in training:
        parts.append(f"{count(training['steps'])} steps")
    if "seconds" in training:
        parts.append(duration(training["seconds"]))
    if "solves" in training:
        parts.append(f"{count(training['solves'])} solves")
    return ", ".join(parts) or UNKNOWN


def count(number: int) -> str:
    """Write a number with three digits: 980, 12.3 k, 1.21 M."""
    for size, unit in ((10**6, " M"), (10**3, " k")):
        if number >= 0.9995 * size:
            value = number / size
            decimals = 2 if value < 9.995 else 1 if value < 99.95 else 0
            return f"{value:.{decimals}f}{unit}"
    return str(number)


def duration(seconds: float) -> str:
    """Write a time in s below 2 min, in min below 2 h, in h beyond."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"
