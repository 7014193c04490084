"""Experiments: cases, rollouts, metrics, results, reports and the command `lpv-track`."""

from importlib.util import find_spec
from pathlib import Path

_found = find_spec("agents")
_folders = (_found.submodule_search_locations if _found else None) or ()
if _found is not None and not any(Path(place, "registry.py").is_file() for place in _folders):
    raise ImportError(
        f"the package 'agents' at {_found.origin} is not lpv-track-env's (openai-agents, for one, "
        "installs a package of that name): use a virtual environment of its own"
    )
