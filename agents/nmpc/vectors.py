"""Vectors of six in compiled code, as tuples: each operation is one call, quick to compile."""

from typing import Any

from numpy.typing import NDArray

from trajectories.compilation import compiled_internal

Array = NDArray[Any]
Float = Any
Six = Any


@compiled_internal
def taken(values: Array, at: int) -> Six:
    """Six numbers of an array, from `at` on."""
    return (
        values[at], values[at + 1], values[at + 2], values[at + 3], values[at + 4], values[at + 5],
    )  # fmt: skip


@compiled_internal
def dot(x: Six, y: Six) -> Float:
    """Inner product x' y."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3] + x[4] * y[4] + x[5] * y[5]


@compiled_internal
def plus(x: Six, y: Six) -> Six:
    """Sum x + y."""
    return x[0] + y[0], x[1] + y[1], x[2] + y[2], x[3] + y[3], x[4] + y[4], x[5] + y[5]


@compiled_internal
def scaled(x: Six, by: Float) -> Six:
    """Vector x times a number."""
    return x[0] * by, x[1] * by, x[2] * by, x[3] * by, x[4] * by, x[5] * by


@compiled_internal
def mixed(a: Float, x: Six, b: Float, y: Six) -> Six:
    """Linear combination a x + b y."""
    return (
        a * x[0] + b * y[0],
        a * x[1] + b * y[1],
        a * x[2] + b * y[2],
        a * x[3] + b * y[3],
        a * x[4] + b * y[4],
        a * x[5] + b * y[5],
    )
