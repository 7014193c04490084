"""What a learned policy cost to make, so that it stands beside what the policy achieves."""

from collections.abc import Mapping
from typing import Any

from agents import Agent
from agents.learned.policy import Policy

KINDS: Mapping[str, tuple[type, ...]] = {
    "steps": (int,),
    "seconds": (int, float),
    "solves": (int,),
    "command": (str,),
}
"""Taken of a policy's `training`: environment steps, wall time (s), NMPC solves, command."""


def of_agent(agent: Agent) -> dict[str, Any]:
    """`{"training": {...}}` for an agent that runs a learned policy, {} for every other.

    It holds `algorithm` and what the policy's `training` has of `KINDS`; an imported policy may
    have less. Agents without a policy were designed by hand, at a cost that nobody recorded.
    """
    policy = getattr(agent, "policy", None)  # delay compensation forwards it
    if not isinstance(policy, Policy):
        return {}
    known = {
        key: policy.training[key]
        for key, kinds in KINDS.items()
        if type(policy.training.get(key)) in kinds
    }
    return {"training": {"algorithm": policy.algorithm, **known}}
