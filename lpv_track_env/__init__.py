"""A Gymnasium environment of a vehicle (dynamic bicycle) that follows reference paths.

Importing this package registers its Gymnasium ids. Gymnasium 1.0 dropped plugin entry points, so
without an import an id must name the module itself:
`gymnasium.make("lpv_track_env:lpv_track_env/PathTracking-v0")`.

Submodules load on first use, as in `lpv_track_env.bicycle.derivative`: nothing heavy is imported
here.
"""

import importlib
import importlib.util
from types import ModuleType

import gymnasium

PATH_TRACKING = "lpv_track_env/PathTracking-v0"
WEIGHT_TUNING = "lpv_track_env/WeightTuning-v0"
HIGHWAY_TRACK = "lpv_track_env/HighwayTrack-v0"

COMPILED_LIBRARY = True
"""Compiled functions of other packages may use this one; see `trajectories.compilation`."""

if PATH_TRACKING not in gymnasium.registry:
    gymnasium.register(
        id=PATH_TRACKING,
        entry_point="lpv_track_env.env:PathTrackingEnv",
        vector_entry_point="lpv_track_env.vector_env:PathTrackingVectorEnv",
        # The environment checks by itself what these wrappers would check, which takes time.
        order_enforce=False,
        disable_env_checker=True,
    )
    gymnasium.register(
        id=WEIGHT_TUNING,
        entry_point="agents.weight_tuning.env:WeightTuningEnv",
        vector_entry_point="agents.weight_tuning.env:WeightTuningVectorEnv",
    )
    gymnasium.register(
        id=HIGHWAY_TRACK,
        entry_point="lpv_track_env.highway.env:HighwayTrackEnv",
        order_enforce=False,
        disable_env_checker=True,
    )


def __getattr__(name: str) -> ModuleType:
    if importlib.util.find_spec(f"{__name__}.{name}") is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.{name}")
