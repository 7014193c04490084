"""`lpv-track verify`: the real-time solver against independent solvers, models and derivatives."""
