"""Runs to put into bags: driven once a process."""

from functools import cache

import gymnasium

import agents
import lpv_track_env  # noqa: F401  registers the ids
from experiments.run.rollout import Trace, rollout
from lpv_track_env.vehicle import VEHICLES

CAR = VEHICLES["m2-minibus"]


@cache
def driven(trajectory: str = "u-turn") -> Trace:
    """A run of PID over a trajectory."""
    env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory=trajectory, vehicle=CAR)
    done = rollout(env, agents.make("pid", env), seed=0)
    assert done.end == "finished"
    return done.trace
