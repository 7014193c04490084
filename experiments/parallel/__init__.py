"""Estimator and controller as processes of their own, beside a vehicle simulated in real time."""
