"""`lpv-track tune` and its study: weights of the NMPC by tables, search, gradients and learning."""
