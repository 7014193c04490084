"""Identification of a vehicle's parameters from logs of its drives (`lpv-track identify`)."""
