"""Robustness of closed loops against switching weights."""
