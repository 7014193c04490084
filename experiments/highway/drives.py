"""One drive in highway-env's traffic: a small plain dict in, a plain dict out."""

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from agents.registry import check_settings, source_file
from experiments.run.case import project_digest
from lpv_track_env import HIGHWAY_TRACK
from lpv_track_env.bicycle import VX

Array = NDArray[np.float64]

OWN = {"idm": "IDM and highway-env's own steering", "idm-mobil": "the same, and it overtakes"}
"""highway-env's own controllers, by name."""


@dataclass(frozen=True)
class TrafficDrive:
    """Everything that determines one drive.

    `agent` is one of this project's, or of `OWN`; `agent_settings` and `env_settings` are keyword
    arguments of the agent's class and of `HighwayTrackEnv`.
    """

    agent: str
    scene: str = "racetrack"
    seed: int = 0
    conditions: str = "simulation"
    control_period: float = 0.05
    agent_settings: Mapping[str, Any] = field(default_factory=dict)
    env_settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """Hash of the drive, the file that its agent is in, and the project's sources."""
        file = None if self.agent in OWN else source_file(self.agent)
        content = "" if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest()
        here = "".join(
            (Path(__file__).parent / name).read_text() for name in ("drives.py", "own.py")
        )
        parts = json.dumps([asdict(self), content, here, project_digest()], sort_keys=True)
        return hashlib.sha256(parts.encode()).hexdigest()[:16]

    def make_env(self, **settings: Any) -> gymnasium.Env[Any, Any]:
        """The environment; `settings` are added to the drive's own."""
        return gymnasium.make(
            HIGHWAY_TRACK,
            scene=self.scene,
            conditions=self.conditions,
            control_period=self.control_period,
            **{"surroundings": None, **self.env_settings, **settings},
        )

    @property
    def trajectory(self) -> str:
        """What is driven, in words."""
        return self.scene

    def check(self) -> None:
        """Refuse agents that nothing knows, and those that only `run_drive` knows.

        Raises
        ------
        ValueError
            Saying which.
        """
        if self.agent in OWN:
            raise ValueError(f"{self.agent} is highway-env's own: it has no picture here")
        check_settings(self.agent, self.agent_settings)

    def make_agent(self, env: gymnasium.Env[Any, Any]) -> agents.Agent:
        """The drive's agent for its environment."""
        return agents.make(self.agent, env, **self.agent_settings)

    def make_computing(self) -> None:
        """Nothing measures computing times here."""


@dataclass
class Record:
    """What is noted every control period, each a list of numbers."""

    lateral_error: list[float] = field(default_factory=list)
    lane_error: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def metrics(self, period: float, progress: float) -> dict[str, float]:
        """Figures of a drive that got `progress` m along its path; SI units, times in s.

        Errors are of the centre of gravity for this project's plant, of the body's centre for
        highway-env's vehicle: its point of reference.
        """
        lateral, lane = np.array(self.lateral_error), np.array(self.lane_error)
        gaps = np.array(self.gap)
        gaps = gaps[np.isfinite(gaps)]
        return {
            "lateral_rms": float(np.sqrt(np.mean(lateral**2))),
            "lateral_max": float(np.abs(lateral).max()),
            "lane_rms": float(np.sqrt(np.mean(lane**2))),
            "mean_speed": float(np.mean(self.speed)),
            "least_speed": float(np.min(self.speed)),
            "duration": period * len(self.speed),
            "progress": progress,
            **({"least_gap": float(gaps.min())} if gaps.size else {}),
            **({"predict_median": float(np.median(self.seconds))} if self.seconds else {}),
        }


def run_drive(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Run one drive; never raises for what the drive itself does wrong.

    Parameters
    ----------
    spec
        Fields of `TrafficDrive`.

    Returns
    -------
    dict
        `id`, the spec's fields, `status` ("ok" or "failed" with `error`), `end`, `others` (their
        number at the start), `metrics`, `seconds`.
    """
    drive = TrafficDrive(**spec)
    result: dict[str, Any] = {"id": drive.id, **asdict(drive), "status": "ok", "error": None}
    began = time.perf_counter()
    try:
        driven = _own(drive) if drive.agent in OWN else _agent(drive)
    except Exception as error:  # noqa: BLE001  a failed drive must not end a sweep
        driven = {"status": "failed", "error": f"{type(error).__name__}: {error}", "end": None,
                  "others": None, "metrics": {}}  # fmt: skip
    return {**result, **driven, "seconds": time.perf_counter() - began}


def _agent(drive: TrafficDrive) -> dict[str, Any]:
    env = drive.make_env()
    inner: Any = env.unwrapped
    agent = drive.make_agent(env)
    observation, info = env.reset(seed=drive.seed)
    others, begin = len(inner.others), info["arc_length"]
    record, memory, start, done = Record(), None, np.array([True]), False
    while not done:
        clock = time.perf_counter()
        action, memory = agent.predict(observation, memory, episode_start=start)
        record.seconds.append(time.perf_counter() - clock)
        start = np.array([False])
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        record.lateral_error.append(info["lateral_error"])
        record.lane_error.append(info["lane_error"])
        record.speed.append(float(info["state"][VX]))
        record.gap.append(info["gap"])
    env.close()
    return {
        "end": info["end"],
        "others": others,
        "metrics": record.metrics(drive.control_period, info["arc_length"] - begin),
    }


def _own(drive: TrafficDrive) -> dict[str, Any]:
    from experiments.highway.own import drive_own

    env: Any = drive.make_env()
    end, others, record, progress = drive_own(
        env.unwrapped, drive.seed, overtakes=drive.agent == "idm-mobil"
    )
    env.close()
    return {
        "end": end,
        "others": others,
        "metrics": record.metrics(drive.control_period, progress),
    }
