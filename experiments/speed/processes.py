"""Sections of fresh processes: peak memory, and time from the start to the first result.

Each measurement starts a child process that does one thing and reports; the clock starts before the
child.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from experiments.speed.measure import Effort, Section, Series, Tick, Unavailable

LIMIT = 300.0
"""Time limit of a child process, s."""
# VmHWM is the peak of this program alone; ru_maxrss also covers the parent before the fork.
REPORT = """
import json, resource, sys, time
done = time.time()
try:
    lines = open("/proc/self/status").read().splitlines()
    peak = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024
except (OSError, StopIteration):
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak *= 1 if sys.platform == "darwin" else 1024
print(json.dumps({"done": done, "peak": peak}))
"""
MAKE = """
import gymnasium, lpv_track_env
env = gymnasium.make("lpv_track_env/PathTracking-v0", trajectory="T2")
observation, _ = env.reset(seed=0)
"""
STEP = MAKE + "env.step(env.action_space.sample())\n"
SOLVE = MAKE + "import agents\nagents.make({name!r}, env).predict(observation)\n"
VECTOR = """
import numpy as np
from lpv_track_env.vector_env import PathTrackingVectorEnv
env = PathTrackingVectorEnv(trajectory="T2", num_envs={n})
env.reset(seed=0)
env.step(np.zeros(({n}, 2), dtype=np.float32))
"""
INTERPRETER = ("bare interpreter", "import lpv_track_env")
"""Programs that compile nothing."""
IPOPT, NMPC, VECTOR_ENV = "first solve of lpv-nmpc-ipopt", "first solve of lpv-nmpc", "vector env"


def programs(large: int) -> dict[str, str]:
    """Return the programs of the child processes by name, with `large` vector environments."""
    return {
        "bare interpreter": "",
        "import lpv_track_env": "import lpv_track_env\n",
        "first step": STEP,
        NMPC: SOLVE.format(name="lpv-nmpc"),
        IPOPT: SOLVE.format(name="lpv-nmpc-ipopt"),
        f"{VECTOR_ENV} of 1": VECTOR.format(n=1),
        f"{VECTOR_ENV} of {large}": VECTOR.format(n=large),
    }


def child(program: str, cache: Path | None = None) -> tuple[float, float]:
    """Return the seconds until a fresh process has run a program, and its peak memory in bytes.

    `cache` replaces the folder of numba's cache.

    Raises
    ------
    Unavailable
        If the process fails, with the last line of its error output.
    """
    environment = dict(os.environ)
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    began = time.time()
    try:
        ended = subprocess.run(  # noqa: S603  our own program
            [sys.executable, "-c", program + REPORT],
            env=environment, capture_output=True, text=True, timeout=LIMIT, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise Unavailable(f"not done within {LIMIT:.0f} s") from None
    if ended.returncode != 0:
        lines = ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"]
        raise Unavailable(lines[-1])
    report: dict[str, Any] = json.loads(ended.stdout.strip().splitlines()[-1])
    return report["done"] - began, float(report["peak"])


def memory(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure peak memory of fresh processes, and bytes per environment of a vector env."""
    section.notes.append("Peak resident set of a fresh process that does this alone.")
    peaks: dict[str, Series] = {}
    for name, program in programs(effort.large).items():
        peaks[name] = section.add(name, "bytes")
        tick(f"memory: {name}")
        try:
            for _ in range(effort.processes):
                peaks[name].rounds.append(child(program)[1])
        except Unavailable as reason:
            section.leave_out(name, str(reason))
    one = peaks.get(f"{VECTOR_ENV} of 1")
    many = peaks.get(f"{VECTOR_ENV} of {effort.large}")
    if one is not None and many is not None:
        each = section.add(f"{VECTOR_ENV}, per environment", "bytes", n=effort.large)
        each.rounds = [
            (large - small) / (effort.large - 1)
            for small, large in zip(one.rounds, many.rounds, strict=False)
        ]


def startup(section: Section, effort: Effort, tick: Tick) -> None:
    """Measure the wall time from starting a process to its first step or solve."""
    section.notes.append(
        "Seconds from starting a process until this is done. Warm: compiled code is in numba's "
        "cache; cold: that cache is an empty folder, as on the first use after an installation."
    )
    possible = programs(effort.large)
    possible.pop(f"{VECTOR_ENV} of {effort.large}", None)
    for name, program in possible.items():
        try:
            tick(f"start-up: {name}, warm")
            child(program)  # fills numba's cache
            warm = section.add(name, "s", cache="warm")
            for _ in range(effort.processes):
                warm.rounds.append(child(program)[0])
            if effort.cold and name not in INTERPRETER:
                tick(f"start-up: {name}, cold")
                cold = section.add(name, "s", cache="cold")
                with tempfile.TemporaryDirectory() as cache:
                    cold.rounds.append(child(program, Path(cache))[0])
        except Unavailable as reason:
            section.leave_out(name, str(reason))
