"""Folders of trainings: policies or weights that differ in their training seed, as one agent.

`lpv-track train --seeds` and `tune --seeds` put the training of seed N into `FOLDER/seed-N`.
"""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import agents
from trajectories.arguments import shown

Spec = dict[str, Any]

TUNED = "lpv-nmpc-tuned"
"""Agent that drives with the weights of a tuning."""
POLICY, WEIGHTS = "policy.json", "weights.json"
SUBFOLDER = re.compile(r"seed-(0|[1-9]\d{0,2})")
FILE = re.compile(
    r"(?:(?P<folder>.+)[/\\])?seed-(?P<seed>0|[1-9]\d{0,2})[/\\](?:policy|weights)\.json",
    re.DOTALL,
)
"""File of one of several trainings."""


class Trained(NamedTuple):
    """Name of an agent, its settings apart from its training, and the training's seed."""

    agent: str
    settings: Mapping[str, Any]
    seed: int | None


def trained(case: Mapping[str, Any]) -> Trained:
    """Return the name of a case's agent, and which of its trainings the case drives.

    The policies in `FOLDER/seed-N/policy.json` are one agent called FOLDER, and so is
    `lpv-nmpc-tuned` with the weights in `FOLDER/seed-N/weights.json`.
    """
    agent, settings = str(case.get("agent", "?")), case.get("agent_settings") or {}
    if found := FILE.fullmatch(agent):
        return Trained(_name(found), settings, int(found["seed"]))
    found = FILE.fullmatch(str(settings.get("weights")))
    if found is None:
        return Trained(agent, settings, None)
    rest = {key: value for key, value in settings.items() if key != "weights"}
    if agent == TUNED:
        return Trained(_name(found), rest, int(found["seed"]))
    return Trained(agent, {**rest, "weights": _name(found)}, int(found["seed"]))


def _name(found: re.Match[str]) -> str:
    """Return the folder of a file; one that is called like a shipped agent gets a "./"."""
    folder = found["folder"] or "."
    return f"./{folder}" if folder in agents.names() else folder


def seed_folder(folder: Path, seed: int) -> Path:
    """Return the folder of the training of a seed."""
    return folder / f"seed-{seed}"


def is_folder(agent: str) -> bool:
    """Return whether the name of an agent is that of a folder."""
    # Unlike Path.is_dir it is False for a name that is too long.
    return agent not in agents.names() and os.path.isdir(agent)  # noqa: PTH112


def trainings_in(folder: str) -> list[Path]:
    """Return the files of a folder's trainings, in the order of their seeds.

    Raises
    ------
    ValueError
        If there are none, or both policies and weights.
    """
    found: dict[str, dict[int, Path]] = {POLICY: {}, WEIGHTS: {}}
    for own in Path(folder).iterdir():
        if seed := SUBFOLDER.fullmatch(own.name):
            for name, files in found.items():
                if (own / name).is_file():
                    files[int(seed[1])] = own / name
    kinds = [files for files in found.values() if files]
    if len(kinds) != 1:
        problem = "policies and weights" if kinds else "no trainings"
        raise ValueError(
            f"folder {shown(folder)} has {problem}: as an agent it must hold seed-N/{POLICY} of "
            f"lpv-track train --seeds, or seed-N/{WEIGHTS} of lpv-track tune --seeds; one policy "
            "is named by its .json"
        )
    return [kinds[0][seed] for seed in sorted(kinds[0])]


def first_training(agent: str) -> Spec:
    """Return agent and settings of a folder's first training; of any other agent its name."""
    return expanded({"agent": agent})[0]


def expanded(spec: Spec) -> list[Spec]:
    """Return a spec for each training of its agent if that is a folder, else the spec itself.

    Raises
    ------
    ValueError
        As `trainings_in`, and for a setting `weights` beside the trainings' own.
    """
    agent = spec["agent"]
    if not is_folder(agent):
        return [spec]
    files = trainings_in(agent)
    if files[0].name == POLICY:
        return [{**spec, "agent": str(file)} for file in files]
    settings = spec.get("agent_settings") or {}
    if "weights" in settings:
        raise ValueError(
            f"{shown(agent)} drives with the weights of its trainings: leave out --agent-set "
            "weights, or give it to another agent as NAME:weights=..."
        )
    return [
        {**spec, "agent": TUNED, "agent_settings": {**settings, "weights": str(file)}}
        for file in files
    ]
