"""Weights of the NMPC by tables, search, gradients and learning; their study; safe switching."""
