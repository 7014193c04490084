"""Estimation of the vehicle's state from its sensors: an extended Kalman filter."""
