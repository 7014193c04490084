"""`lpv-track highway`: agents in highway-env's traffic, beside its own controllers."""
