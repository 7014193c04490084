"""Files and modules that a result names, so that those of a stranger are opened only if allowed."""

import os
import re
from collections.abc import Mapping
from itertools import chain
from typing import Any

import trajectories
from agents import names as agent_names
from experiments.run.traffic import OWN
from lpv_track_env.vehicle import VEHICLES

MADE = re.compile(r"(random(-fast|-limit)?|circuit)-\d{1,18}|iso-3888-[12]-\d{1,4}(\.\d{1,8})?")
"""Names of random paths, circuits and lane changes, which no file stands behind."""
FILE_LIKE = re.compile(r"[/\\.]")
"""Characters of a setting that may name a file."""


def is_path_file(trajectory: str) -> bool:
    """Return whether a trajectory is not a name that this project knows, so that it is a file."""
    return trajectory not in trajectories.names() and MADE.fullmatch(trajectory) is None


def opened_by(result: Mapping[str, Any]) -> list[str]:
    """Return the names of all files and modules that running a result's case would open or execute.

    They are the agent unless it is one of this project's, whose code would run, and the files of
    settings, of the path and of the vehicle. Nothing is opened or imported to find out.
    """
    found = []
    if "agent" in result and result["agent"] not in (*agent_names(), *OWN):
        found.append(str(result["agent"]))
    settings = [(result.get(key) or {}).values() for key in ("agent_settings", "env_settings")]
    found += [
        value
        for value in chain(*settings)
        if isinstance(value, str) and (FILE_LIKE.search(value) or os.path.exists(value))  # noqa: PTH110
    ]
    if "trajectory" in result and is_path_file(str(result["trajectory"])):
        found.append(str(result["trajectory"]))
    if (vehicle := str(result.get("vehicle", "m2-minibus"))) not in VEHICLES:
        found.append(vehicle)
    return found
