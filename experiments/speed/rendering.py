"""Section of the pictures: frames of a whole drive, with everything that they show."""

import time
from typing import Any

import numpy as np

from experiments.agent_words import agent_notes, world_plan
from experiments.run.case import Case
from experiments.run.rollout import steps
from experiments.speed.measure import Effort, Section, Tick

TRAJECTORY, AGENT = "T3", "lpv-nmpc"


def rendering(section: Section, effort: Effort, tick: Tick) -> None:
    """Every frame of a drive as an array, on one core, the agent's plan and weights shown."""
    case = Case(agent=AGENT, trajectory=TRAJECTORY)
    env = case.make_env(render_mode="rgb_array")
    agent = case.make_agent(env)
    inner: Any = env.unwrapped
    series = section.add(f"{AGENT} on {TRAJECTORY}", "s/frame")
    processor = 0.0
    tick("frames of a drive")
    for k, info in steps(env, agent, seed=0):
        inner.show_agent(world_plan(info), agent_notes(AGENT, info))
        began, busy = time.perf_counter(), time.process_time()
        frame = inner.render()
        series.rounds.append(time.perf_counter() - began)
        processor += time.process_time() - busy
        if k % 100 == 0:
            tick(f"frames of a drive: {k}")
        if k >= effort.frames:
            break
    height, width = frame.shape[:2]
    total = float(np.sum(series.rounds))
    section.notes.append(
        f"Seconds per render() of each of {len(series.rounds)} frames, {width} x {height} pixels, "
        f"as an array: {len(series.rounds) / total:.0f} frames a second over all of them, the "
        f"first with what it prepares included; {len(series.rounds) / processor:.0f} a second of "
        "processor time, which what else runs disturbs less."
    )
    env.close()
