"""A Gymnasium environment of a vehicle (dynamic bicycle) that follows reference paths.

Importing this package registers its Gymnasium ids. Submodules load on first use:
`lpv_track_env.bicycle.derivative`.
"""

import importlib
from types import ModuleType

from lpv_track_env.registration import register

_SUBMODULES = (
    "actions",
    "bicycle",
    "conditions",
    "draws",
    "env",
    "episodes",
    "estimation",
    "highway",
    "integration",
    "kernels",
    "lpv",
    "observation",
    "plants",
    "rendering",
    "reward",
    "sensors",
    "task",
    "threads",
    "vector_checks",
    "vector_env",
    "vector_infos",
    "vector_kernels",
    "vehicle",
)

COMPILED_LIBRARY = True
"""Compiled functions of other packages may use this one: see `trajectories.compilation`."""

register()


def __getattr__(name: str) -> ModuleType:
    if name in _SUBMODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
