"""Experiments: cases, rollouts, metrics, results, reports and the command `lpv-track`."""

import agents

if not hasattr(agents, "TrackingAgent"):
    raise ImportError(
        f"the package 'agents' at {agents.__file__} is not lpv-track-env's (openai-agents, for "
        "one, installs a package of that name): use a virtual environment of its own"
    )
