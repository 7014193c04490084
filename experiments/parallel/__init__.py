"""Estimator and controller as separate processes, driving a vehicle simulated in real time."""
