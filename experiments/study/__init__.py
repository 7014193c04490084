"""The tuning study: rungs, oracles, evaluation and report."""
