"""Cases, their rollouts, metrics and result folders."""
