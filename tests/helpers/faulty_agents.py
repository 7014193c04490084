"""Faulty agents for tests, named faulty_agents.py:Class."""

import contextlib
import ctypes
import os
import sys
import time
import warnings

import numba
import numpy as np

from experiments.parallel.control import WARM_UP


class Hangs:
    """Drives straight on, and hangs after some periods."""

    def __init__(self, task) -> None:
        self.rolling = task.vehicle.rolling_deceleration
        self.calls = 0

    def predict(self, _observation, state=None, *_, **__):
        self.calls += 1
        if self.calls > WARM_UP + 8:
            time.sleep(3600.0)
        return np.array([self.rolling, 0.0]), state


class Rolls:
    """Drives straight on until it leaves the road; the base of those that do worse."""

    def __init__(self, task) -> None:
        self.rolling = task.vehicle.rolling_deceleration

    def predict(self, _observation, state=None, *_, **__):
        return np.array([self.rolling, 0.0]), (state,)


class Moves(Rolls):
    """Changes the working directory."""

    def predict(self, observation, state=None, *_, **__):
        os.chdir("/")
        return super().predict(observation, state)


class Explains(Rolls):
    """Reports values of NumPy's types, which JSON does not know."""

    numbers = np.float32(0.25), np.int64(3)

    def diagnostics(self, _memory):
        seconds, iterations = self.numbers
        return {
            "status": np.int64(7), "fallback": None, "seconds": seconds, "iterations": iterations,
            "slack": np.zeros(3),
        }  # fmt: skip


class ExplainsNothing(Explains):
    """Reports iterations that are no number."""

    numbers = 0.1, float("nan")


class Exits(Rolls):
    """Ends the program."""

    def predict(self, *_, **__):
        sys.exit("enough")


class UnreadableError(Exception):
    """Has no message that can be read."""

    def __str__(self) -> str:
        raise RuntimeError("no message")


class RaisesUnreadably(Rolls):
    """Raises an exception whose message raises."""

    def predict(self, *_, **__):
        raise UnreadableError


class Shouts(Rolls):
    """Raises a message that is long, that no terminal should see, and that is no text."""

    def predict(self, *_, **__):
        raise ValueError("\x1b[31m" + "loud " * 100_000 + "\ud800")


class Interrupts(Rolls):
    """Raises what Ctrl-C raises."""

    def predict(self, *_, **__):
        raise KeyboardInterrupt


class Loops(Rolls):
    """Never ends, and refuses to be stopped by exceptions."""

    def predict(self, *_, **__):
        while True:
            with contextlib.suppress(Exception):
                time.sleep(0.01)


class SwallowsAll(Rolls):
    """An agent that takes long and catches whatever comes."""

    def predict(self, observation, state=None, *_, **__):
        with contextlib.suppress(BaseException):
            time.sleep(0.05)
        return super().predict(observation, state)


class WarnsOfTheMachine(Rolls):
    """An agent that warns of something that is not of its result."""

    def predict(self, observation, state=None, *_, **__):
        warnings.warn("the machine is odd", RuntimeWarning, stacklevel=1)
        return super().predict(observation, state)


class Sticks(Rolls):
    """Waits for ever in native code, which holds the interpreter."""

    def predict(self, *_, **__):
        ctypes.PyDLL(None).pause()


class Compiles:
    """Drives straight on, and compiles a function after some periods."""

    def __init__(self, task) -> None:
        self.rolling = task.vehicle.rolling_deceleration
        self.calls = 0

    def predict(self, _observation, state=None, *_, **__):
        self.calls += 1
        action = np.array([self.rolling, 0.0])
        if self.calls > WARM_UP + 4:
            action = late(action)
        return action, state


@numba.njit
def late(x):
    return x + 0.0
