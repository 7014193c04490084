"""Folders of hand-made results of two agents, which a comparison meets."""

from pathlib import Path

from tests.helpers.made_results import case, folder_of


def results(agent, errors, first=0, **more):
    """Return results of one agent: a path's ALE by seed, None for a drive that failed."""
    found = []
    for path, values in errors.items():
        for seed, value in enumerate(values):
            metrics = {} if value is None else {"ale": value}
            end = "left_corridor" if value is None else "finished"
            given = {"seed": seed, "end": end, "conditions": "realtime", **more}
            found.append(case(first + len(found), agent, path, metrics, **given))
    return found


def folder(path: Path, *agents):
    """Write results of agents (name, errors) into one folder."""
    folder_of(
        path,
        [
            one
            for place, (agent, errors) in enumerate(agents)
            for one in results(agent, errors, 1000 * place)
        ],
        traces=False,
    )
    return path
