"""Tuning of the NMPC's weights by tables, search, gradients and learning: `lpv-track tune`."""

METHODS = ("fixed", "paper", "search", "bands", "gradient", "catalogue", "rl", "paired")
"""Names of the methods."""
