"""`lpv-track drive`: watch one run live, or write its frames."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from experiments.cases import Case
from experiments.interrupts import Interrupts
from experiments.rollout import rollout
from lpv_track_env.bicycle import PSI, X, Y

Array = NDArray[np.float64]


def world_plan(info: dict[str, Any]) -> Array | None:
    """An agent's predicted positions (n, 2) m in the world, from the foot point's frame.

    The frame belongs to the step that has just been driven: the foot point is found back from the
    plan's own start, which is the vehicle, so the plan is drawn from where the vehicle now is.
    """
    plan = info.get("agent", {}).get("plan")
    if plan is None or len(plan) < 3:
        return None
    state = info["state"]
    heading = state[PSI] - info["heading_error"]
    c, s = math.cos(heading), math.sin(heading)
    ahead = np.asarray(plan)[1:] - np.asarray(plan)[1]
    return np.column_stack(
        [state[X] + c * ahead[:, 0] - s * ahead[:, 1], state[Y] + s * ahead[:, 0] + c * ahead[:, 1]]
    )


def drive(case: Case, console: Console, *, frames: Path | None = None, every: int = 1) -> int:
    """Drive one case and show it; write a PNG every `every` steps instead if `frames` is given.

    Raises
    ------
    ValueError
        If `every` is not positive, or there is nothing to draw on.
    """
    if every < 1:
        raise ValueError(f"--every must be at least 1, not {every}")
    env = case.make_env(render_mode="human" if frames is None else "rgb_array")
    agent = case.make_agent(env)
    inner: Any = env.unwrapped
    count = 0
    if frames is not None:
        frames.mkdir(parents=True, exist_ok=True)

    def show(step: int, info: dict[str, Any]) -> None:
        nonlocal count
        interrupts.check()
        inner.show_plan(world_plan(info))
        if frames is not None and step % every == 0:
            save(inner.render(), frames / f"frame-{step:06d}.png")
            count += 1

    try:
        # Before the run, so that what drawing lacks is told at once.
        env.reset(seed=case.seed)
        inner.render()
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    with Interrupts() as interrupts:
        done = rollout(env, agent, seed=case.seed, on_step=show)
    worst = float(np.abs(done.trace.lateral_error).max())
    where = "" if frames is None else f"; {count} frames in {frames}"
    console.print(
        f"{case.agent} on {case.trajectory}: {done.end} after {done.trace.time[-1]:.1f} s, "
        f"largest lateral error {worst:.3f} m{where}",
        markup=False, highlight=False, soft_wrap=True,
    )  # fmt: skip
    env.close()
    return 0 if done.end == "finished" else 1


def save(frame: NDArray[np.uint8], file: Path) -> None:
    """Write a frame (height, width, 3) as PNG, atomically."""
    import io

    import pygame

    from trajectories.atomic import write_atomically

    surface = pygame.surfarray.make_surface(frame.swapaxes(0, 1))
    buffer = io.BytesIO()
    pygame.image.save(surface, buffer, "frame.png")
    write_atomically(file, buffer.getvalue())
