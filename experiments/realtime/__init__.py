"""Experiments on the conditions of a real vehicle: what each costs, and what computing time does.

`ablation` and `latency` are commands of `lpv-track`.
"""
