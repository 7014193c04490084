"""Learned policies: what they are, their files, and the agents that run them without torch."""

from agents.learned.files import read, write
from agents.learned.policy import Policy

__all__ = ["Policy", "read", "write"]
