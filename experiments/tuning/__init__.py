"""Tuning of the NMPC's weights: searches, training, and how safe it is to switch them."""
