"""The LPV-NMPC: one optimal control problem, several solvers, one agent around them."""
