"""A Gymnasium environment of a vehicle (dynamic bicycle) that follows reference paths.

Importing this package registers its Gymnasium ids. Gymnasium 1.0 dropped plugin entry points, so
without an import an id must name the module itself:
`gymnasium.make("lpv_track_env:lpv_track_env/PathTracking-v0")`.

Submodules load on first use, as in `lpv_track_env.bicycle.derivative`: nothing heavy is imported
here.
"""

import importlib
import importlib.util
import warnings
from pathlib import Path
from types import ModuleType

import gymnasium

PATH_TRACKING = "lpv_track_env/PathTracking-v0"
WEIGHT_TUNING = "lpv_track_env/WeightTuning-v0"
HIGHWAY_TRACK = "lpv_track_env/HighwayTrack-v0"

COMPILED_LIBRARY = True
"""Compiled functions of other packages may use this one; see `trajectories.compilation`."""


def _check_neighbours() -> None:
    """Report a folder or file beside the user's script that hides a package of this project.

    Python finds it first, with or without an `__init__.py`. The environments need `trajectories`;
    a user who needs no agents may have an `agents` of their own.
    """
    home = Path(__file__).parent.parent
    for name in ("trajectories", "agents", "experiments"):
        spec = importlib.util.find_spec(name)
        found = spec and next(iter(spec.submodule_search_locations or ()), spec.origin)
        if not found or Path(found).resolve() == (home / name).resolve():
            continue
        message = (
            f"{found} hides the package {name!r} of lpv-track-env: rename it, or run your script "
            "from another folder"
        )
        if name == "trajectories":
            raise ImportError(message)
        warnings.warn(message, UserWarning, stacklevel=3)


_check_neighbours()
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
