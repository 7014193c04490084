"""The controller's process: estimates in, commands out; it brakes on stale or invalid estimates."""

import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import agents
from agents import Agent
from agents.base import stopping_acceleration
from experiments.parallel.child_processes import READY, Link
from experiments.parallel.mailbox import Reader, Writer
from experiments.parallel.setup import (
    COMMAND,
    DRIVING,
    FAILED,
    NO_FIX,
    NOT_FINITE,
    STALE_ESTIMATE,
    STALE_PERIODS,
    Setup,
)
from experiments.run.case import in_words
from lpv_track_env.bicycle import VX, X, Y
from lpv_track_env.estimation.observer import PathObserver
from lpv_track_env.vehicle import VehicleParameters

WARM_UP = 20
"""Calls of `predict` before the clock starts."""
FAR = 1.0
"""Distance between two estimates beyond which the place on the path is searched anew, m."""
MAX_FAILURES = 10
"""Consecutive failed calls of `predict` after which the process ends."""


def control(link: Link, setup: Setup, estimates: Reader, commands: Writer) -> None:
    """Answer every estimate with a command until the supervisor stops the process.

    Raises
    ------
    RuntimeError
        When the agent has failed ten times in a row; each failure before that brakes.
    """
    with estimates, commands:
        controller = prepared(setup)
        link.report(READY)
        with link.quiet():
            serve(link, controller, estimates, commands)


def serve(link: Link, controller: "Controller", estimates: Reader, commands: Writer) -> None:
    """Answer estimates as they arrive, and brake when none does."""
    while not link.stopped():
        message = estimates.wait(controller.patience(time.monotonic_ns()))
        if message is not None:
            controller.answer(message.value, message.stamp)
            commands.put(controller.command)
        elif controller.is_stale(time.monotonic_ns()):
            controller.brake_on_stale()
            commands.put(controller.command)


def prepared(setup: Setup) -> "Controller":
    """Return a controller whose agent has been called, so that everything is compiled."""
    env = setup.task_env()
    agent = agents.make(setup.agent, env, **setup.agent_settings)
    observer = PathObserver(env.path, env.layout)
    path = env.path
    state = np.array([path.speed[0], 0.0, path.heading[0], 0.0, path.x[0], path.y[0]])
    observer.begin(state, near=0.0)
    for k in range(WARM_UP):
        observation = observer.observe(state, env.vehicle.rolling_deceleration, 0.0)
        agent.predict(observation, episode_start=np.array([k == 0]))
    return Controller(agent, observer, env.vehicle, setup)


class Controller:
    """Commands of an agent to the vehicle, estimate by estimate."""

    def __init__(
        self, agent: Agent, observer: PathObserver, vehicle: VehicleParameters, setup: Setup
    ) -> None:
        self._agent, self._observer, self._vehicle = agent, observer, vehicle
        self._period, self._max_fix_age = setup.period, setup.known_conditions.max_fix_age
        self._stale_after = STALE_PERIODS * setup.period_ns
        self._memory: Any = None
        self._start = np.array([True])
        self._in_a_row = 0
        self._speed = 0.0
        self._place = (math.inf, math.inf)
        self.command: NDArray[Any] = np.zeros((), COMMAND)
        """Last command; its `due` is 0 before the first."""

    def is_stale(self, now: int) -> bool:
        """Return whether the newest estimate is three control periods old at time `now` (ns)."""
        due = int(self.command["due"])
        return due > 0 and now - due >= self._stale_after

    def patience(self, now: int) -> float:
        """Return the time to wait for an estimate, s: until the newest is stale, then a period."""
        left = 1e-9 * (int(self.command["due"]) + self._stale_after - now)
        return min(left, self._period) if left > 0.0 else self._period

    def answer(self, estimate: Any, estimated: int) -> None:
        """Set the command for an ESTIMATE record that was written at time `estimated` (ns)."""
        command = self.command
        command["period"], command["due"] = estimate["period"], estimate["due"]
        command["estimated"] = estimated
        command["solve_time"] = 0.0
        state, steering_angle = estimate["state"], float(estimate["steering_angle"])
        self._speed = float(state[VX])
        if not np.isfinite(state).all():
            # The observer would lose the place on the path.
            self._speed = math.nan
            self._brake(NOT_FINITE, steering_angle)
            return
        offset = float(estimate["steering_offset"])
        # Also if the command will be to brake, so as not to lose the place on the path.
        self._follow(float(state[X]), float(state[Y]))
        observation = self._observer.observe(
            state, float(estimate["acceleration"]), steering_angle + offset
        )
        if self.is_stale(time.monotonic_ns()):
            self._brake(STALE_ESTIMATE, steering_angle)
        elif estimate["fix_age"] > self._max_fix_age:
            self._brake(NO_FIX, steering_angle)
        else:
            self._drive(observation, steering_angle, offset)

    def _follow(self, x: float, y: float) -> None:
        """Find the place on the path again if estimates were missed."""
        moved = math.hypot(x - self._place[0], y - self._place[1])
        if FAR < moved < math.inf:
            near = self._observer.arc_length + moved
            self._observer.begin([0.0, 0.0, 0.0, 0.0, x, y], near=near)
        self._place = (x, y)

    def _drive(
        self, observation: NDArray[np.float32], steering_angle: float, offset: float
    ) -> None:
        command = self.command
        began = time.perf_counter()
        try:
            action, self._memory = self._agent.predict(
                observation, self._memory, episode_start=self._start
            )
            a, delta = map(float, action)
            if not (math.isfinite(a) and math.isfinite(delta)):
                raise ValueError(f"the action is not finite: {action}")
        except Exception as error:
            command["solve_time"] = time.perf_counter() - began
            command["failures"] += 1
            self._in_a_row += 1
            if self._in_a_row >= MAX_FAILURES:
                raise RuntimeError(
                    f"predict failed {MAX_FAILURES} times in a row, last with {in_words(error)}"
                ) from error
            self._brake(FAILED, steering_angle)
            return
        command["solve_time"] = time.perf_counter() - began
        command["reason"] = DRIVING
        command["acceleration"], command["steering_angle"] = a, delta - offset
        self._start = np.array([False])
        self._in_a_row = 0

    def brake_on_stale(self) -> None:
        """Set a command to brake for lack of estimates: steering held, speed extrapolated."""
        if self.command["reason"] == STALE_ESTIMATE:
            a = float(self.command["acceleration"]) - self._vehicle.rolling_deceleration
            self._speed = max(self._speed + a * self._period, 0.0)
        self.command["solve_time"] = 0.0
        self._brake(STALE_ESTIMATE, float(self.command["steering_angle"]))

    def _brake(self, reason: int, steering_angle: float) -> None:
        self.command["reason"] = reason
        self.command["acceleration"] = stopping_acceleration(self._vehicle, self._speed)
        self.command["steering_angle"] = steering_angle
