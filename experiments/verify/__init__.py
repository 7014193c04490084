"""Measures of `lpv-track verify`: the real-time solver against independent oracles."""
