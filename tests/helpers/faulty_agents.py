"""Faulty agents for tests, named faulty_agents.py:Class."""

import time

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
