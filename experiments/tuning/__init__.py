"""`lpv-track tune` and its study: weights of the NMPC by tables, search, gradients and learning.

`safety` is `lpv-track switching`: whether vehicles are lost when weights are switched.
"""
