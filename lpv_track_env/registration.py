"""Gymnasium ids of this package.

Gymnasium 1.0 dropped plugin entry points, so an id is known once `lpv_track_env` is imported, or
when it names the module itself: `gymnasium.make("lpv_track_env:lpv_track_env/PathTracking-v0")`.
Nothing heavy is imported here.
"""

import gymnasium

PATH_TRACKING = "lpv_track_env/PathTracking-v0"
WEIGHT_TUNING = "lpv_track_env/WeightTuning-v0"
HIGHWAY_TRACK = "lpv_track_env/HighwayTrack-v0"


def register() -> None:
    """Register every id, once."""
    if PATH_TRACKING not in gymnasium.registry:
        gymnasium.register(
            id=PATH_TRACKING,
            entry_point="lpv_track_env.env:PathTrackingEnv",
            vector_entry_point="lpv_track_env.vector_env:PathTrackingVectorEnv",
            # The environment refuses by itself what these wrappers would: each costs time.
            order_enforce=False,
            disable_env_checker=True,
        )
        gymnasium.register(
            id=WEIGHT_TUNING,
            entry_point="agents.weight_tuning.env:WeightTuningEnv",
            vector_entry_point="agents.weight_tuning.vector_env:WeightTuningVectorEnv",
        )
        gymnasium.register(
            id=HIGHWAY_TRACK,
            entry_point="lpv_track_env.highway.env:HighwayTrackEnv",
            order_enforce=False,
            disable_env_checker=True,
        )
