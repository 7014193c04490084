"""Sections of `lpv-track speed`: environments, solvers, closed loops, learning, processes."""
