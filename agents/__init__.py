"""Agents of lpv-track-env: everything that drives, behind one `predict`.

`make(name, env, **settings)` makes one; `names()` lists them.
"""

from agents.base import Agent, DrivingTask, TrackingAgent
from agents.registry import make, names

__all__ = ["Agent", "DrivingTask", "TrackingAgent", "make", "names"]
