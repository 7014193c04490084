"""Training of learned policies: `lpv-track train`."""

ALGORITHMS = ("ppo", "sac", "td3", "bc", "residual")
"""Names of the algorithms."""
