"""Drives with pictures: agents side by side, shown in a window or written as files or a video."""

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from agents.weights import in_words
from experiments.run.case import BaseCase
from experiments.run.engines import Interrupts
from experiments.run.rollout import Rollout, steps
from experiments.sinks import Frame, PngSink, Sink, VideoSink, WindowSink
from lpv_track_env.bicycle import PSI, X, Y

Array = NDArray[np.float64]

SEAM = (224, 228, 234)
"""Colour of the line between frames side by side."""


class Drive:
    """A case that is driven step by step, and its picture.

    Parameters
    ----------
    case
        The case.
    colour
        Quantity that colours the path, see `lpv_track_env.rendering.Renderer`.
    """

    def __init__(self, case: BaseCase, colour: str) -> None:
        self.case = case
        self._env = case.make_env(render_mode="rgb_array", render_colour=colour)
        self._inner: Any = self._env.unwrapped
        agent = case.make_agent(self._env)
        self._steps: Iterator[tuple[int, dict[str, Any]]] = self._drive(agent)
        self._frame: Frame | None = None
        self.done: Rollout | None = None
        """Outcome of the drive once it has ended."""

    @property
    def expected_steps(self) -> int:
        """Number of control periods that the reference takes."""
        return max(round(float(self._inner.path.duration / self._inner.control_period)), 1)

    @property
    def finished(self) -> bool:
        """True once the drive has reached the end of the path."""
        return self.done is not None and self.done.end == "finished"

    def _drive(self, agent: Any) -> Iterator[tuple[int, dict[str, Any]]]:
        self.done = yield from steps(
            self._env,
            agent,
            seed=self.case.seed,
            options=self.case.reset_options,
            computing_time=self.case.make_computing(),
        )

    def advance(self) -> bool:
        """Drive one control period and return True, or False once the episode has ended."""
        for _, info in self._steps:
            self._frame = None
            self._inner.show_agent(world_plan(info), agent_notes(self.case.agent, info))
            return True
        return False

    def frame(self) -> Frame:
        """Return the present picture (600, 900, 3), the last one after the end of the drive."""
        if self._frame is None:
            self._frame = self._inner.render()
        return self._frame

    def close(self) -> None:
        """Close the environment and its drawing."""
        self._env.close()


def drive(
    cases: Sequence[BaseCase],
    console: Console,
    *,
    frames: Path | None = None,
    every: int = 1,
    video: Path | None = None,
    fps: float | None = None,
    speed_up: float = 1.0,
    colour: str = "speed",
) -> int:
    """Drive cases side by side and show them, or write frames or a video.

    Returns 0 if every agent has finished, else 1.

    Parameters
    ----------
    cases
        One case, or several of one control period; an agent that ends before the others stays in
        the picture.
    console
        Receives the outcome and, on a terminal, the progress.
    frames, every
        Folder of PNG files, one every so many steps.
    video, fps, speed_up
        File of a video, .mp4 or .gif, its frames a second (by default one frame a control period,
        at most 50) and how many times faster than the drive it runs. Its last frame stays for a
        second.
    colour
        Quantity that colours the path: "speed" or "curvature".

    Raises
    ------
    ValueError
        If `every`, `fps` or `speed_up` are out of range, both frames and a video are asked for, or
        there is nothing to draw on.
    ModuleNotFoundError
        In one line that names the extra to install, for a video without an encoder.
    """
    sink = _sink(cases[0].control_period, frames, every, video, fps, speed_up)
    for one in cases:
        one.check()
    with ExitStack() as stack:
        # First of all, so that a missing display or encoder is reported at once.
        stack.enter_context(sink)
        drives = [Drive(one, colour) for one in cases]
        for driven in drives:
            stack.callback(driven.close)
        with Interrupts() as interrupts, _progress(console, live=sink.live) as progress:
            bar = progress.add_task("drive", total=max(driven.expected_steps for driven in drives))
            for _ in play(drives, sink):
                interrupts.check()
                progress.advance(bar)
    for driven in drives:
        _print_outcome(driven, console)
    if sink.outcome:
        console.out(sink.outcome, highlight=False)
    return 0 if all(driven.finished for driven in drives) else 1


def play(drives: Sequence[Drive], sink: Sink) -> Iterator[int]:
    """Drive all of them into a sink until the last has ended; yield each step's number."""
    step = 0
    # A list, not a generator, so that every one is driven.
    while any([one.advance() for one in drives]):  # noqa: C419
        step += 1
        if times := sink.copies(step):
            sink.add(step, beside([one.frame() for one in drives]), times)
        yield step
    sink.end(lambda: beside([one.frame() for one in drives]))


def world_plan(info: dict[str, Any]) -> Array | None:
    """Return an agent's predicted positions (n, 2) m in the world; None without a plan.

    The plan is in the frame of the foot point of the step that has just been driven. It is moved so
    that it starts at the vehicle's present position.
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


def agent_notes(name: str, info: dict[str, Any]) -> dict[str, str]:
    """Return notes for the picture by label: the agent's name, its last solve, its weights.

    They do not depend on the speed of the computer, so that equal drives give equal frames.
    """
    notes, solve = {"agent": name}, info.get("agent", {})
    if "status" in solve:
        count = solve["iterations"]
        notes["solver"] = f"{solve['status']}, {count} iteration{'' if count == 1 else 's'}"
        # A row in any case, so that the card keeps its size.
        notes["fallback"] = solve.get("fallback") or "none"
    if solve.get("weights") is not None:
        notes |= in_words(solve["weights"])
    if info.get("stopping"):
        notes["vehicle"] = "brakes by itself"
    return notes


def beside(frames: Sequence[Frame]) -> Frame:
    """Return frames (height, width, 3) side by side with a thin line between them."""
    if len(frames) == 1:
        return frames[0]
    picture: Frame = np.concatenate(frames, axis=1)
    for k in range(1, len(frames)):
        seam = k * frames[0].shape[1]
        picture[:, seam - 1 : seam + 1] = SEAM
    return picture


def _sink(
    period: float, frames: Path | None, every: int, video: Path | None, fps: float | None,
    speed_up: float,
) -> Sink:  # fmt: skip
    """Make the sink that the arguments of `drive` ask for."""
    if every < 1:
        raise ValueError(f"--every must be at least 1, not {every}")
    if frames is not None and video is not None:
        raise ValueError("give --frames or --video, not both")
    if video is None and (fps is not None or speed_up != 1.0):
        raise ValueError("--fps and --speed-up are for --video FILE")
    if video is not None:
        return VideoSink(video, period, fps, speed_up)
    if frames is not None:
        return PngSink(frames, every)
    return WindowSink(max(round(1.0 / period), 1))


def _progress(console: Console, *, live: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f} steps"),
        TimeElapsedColumn(), console=console, disable=live or not console.is_terminal,
        transient=True,
    )  # fmt: skip


def _print_outcome(one: Drive, console: Console) -> None:
    assert one.done is not None
    trace = one.done.trace
    worst = float(np.abs(trace.lateral_error).max())
    console.out(
        f"{one.case.agent} on {one.case.place}: {one.done.end} after {trace.time[-1]:.1f} s, "
        f"largest lateral error {worst:.3f} m",
        highlight=False,
    )
