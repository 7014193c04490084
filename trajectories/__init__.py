"""Reference trajectories: geometry, curvature, speed profiles, files.

`load(name_or_file)` gives a `ReferencePath`; `names()` lists what ships.
"""

from trajectories.catalog import PUBLISHED, load, names
from trajectories.curvature import CurvatureBands, PathStatistics, statistics
from trajectories.path import Preview, Projection, ReferencePath
from trajectories.random_paths import random_path
from trajectories.speed import SpeedLimits, plan_speed

__all__ = [
    "PUBLISHED",
    "CurvatureBands",
    "PathStatistics",
    "Preview",
    "Projection",
    "ReferencePath",
    "SpeedLimits",
    "load",
    "names",
    "plan_speed",
    "random_path",
    "statistics",
]
