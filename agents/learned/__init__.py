"""Learned policies: their files, and the agents that run them without torch."""

from agents.learned.policy import Policy, read, write

__all__ = ["Policy", "read", "write"]
