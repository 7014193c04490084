"""Closed loops for tests: in compiled code, and the same by `predict` and `step` in turns."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import agents
from agents.nmpc.rti_agent import RtiNmpc
from agents.weight_tuning.agent import TunedNmpc
from agents.weight_tuning.closed_loop import ClosedLoop, Tally
from lpv_track_env import kernels as k
from lpv_track_env.conditions import layout
from lpv_track_env.vector_env import PathTrackingVectorEnv
from tests.helpers.nmpc_situations import WEIGHTS

Array = NDArray[Any]

# Two paths, two vehicles; some end within seconds, by the corridor or by time.
LIVELY: dict[str, Any] = {
    "trajectory": ["figure-eight", "T1"],
    "vehicle": ["m2-minibus", "course-car"],
    "initial_error_range": (0.6, 0.2, 2.0),
    "random_start": True,
    "max_lateral_error": 0.65,
    "time_limit": 1.8,
}
# None of these ends within the tests.
CALM: dict[str, Any] = {**LIVELY, "max_lateral_error": 5.0, "time_limit": 60.0}


def environments(n: int, **settings: Any) -> PathTrackingVectorEnv:
    return PathTrackingVectorEnv(n, **{"autoreset_mode": "Disabled", **settings})


def loop_of(n: int, settings: dict[str, Any], *, threads: int = 1, **more: Any) -> ClosedLoop:
    envs = environments(n, **settings)
    return ClosedLoop(envs, agents.make("lpv-nmpc", envs.single, **more), threads=threads)


def weights_of(n: int) -> Array:
    """A set for each environment."""
    return WEIGHTS * 10.0 ** np.random.default_rng(0).uniform(-0.7, 0.7, (n, len(WEIGHTS)))


def busy(env: PathTrackingVectorEnv) -> bool:
    """Whether the controller of a single environment still computes an earlier action."""
    if (given := env.condition_arrays) is None:
        return False
    now = env.records[0, k.STEPS] * env.single.control_period
    return bool(given[0][0, layout.FREE_AT] > now + layout.TIME_TOLERANCE)


class InTurns:
    """n environments of one each, with an agent each: `predict`, then `step`, in Python."""

    def __init__(
        self, n: int, settings: dict[str, Any], sets: Array | None, name: str = "lpv-nmpc",
        **more: Any,
    ) -> None:  # fmt: skip
        self.envs = [environments(1, **settings) for _ in range(n)]
        self.agents: list[Any] = []
        for i, env in enumerate(self.envs):
            agent: Any = agents.make(name, env.single, **more)
            assert isinstance(getattr(agent, "agent", agent), (RtiNmpc, TunedNmpc))
            assert sets is None or agent.set_weights(sets[i])
            self.agents.append(agent)
        self.failures, self.iterations = np.zeros(n), np.zeros(n)
        self.fallbacks: list[str] = [""] * n
        self.actions = np.zeros((n, 1, 2), dtype=np.float32)

    def reset(self, rows: Any = None, *, seed: int | None = None, **options: Any) -> None:
        for i in range(len(self.envs)) if rows is None else rows:
            self.envs[i].reset(seed=None if seed is None else seed + i, options=options)
            self.agents[i].reset()

    def drive(self, periods: int) -> Array:
        """Records after each period, (n, periods, RECORD_SIZE); NaN where the episode is over."""
        trace = np.full((len(self.envs), periods, k.RECORD_SIZE), np.nan)
        for i, (env, agent) in enumerate(zip(self.envs, self.agents, strict=True)):
            for period in range(periods):
                if env.arrays.ends[0] != k.RUNNING:
                    break
                if busy(env):
                    agent.hold()
                else:
                    # A copy: tests put what they like in place of what is seen.
                    actions, memory = agent.predict(env.arrays.observations.copy())
                    self.actions[i] = actions
                    report = agent.diagnostics(memory[0])
                    self.failures[i] += report["status"] != "SUCCESS"
                    self.iterations[i] += report["iterations"]
                    self.fallbacks[i] = report["fallback"]
                env.step(self.actions[i])
                trace[i, period] = env.records[0]
        return trace


def assert_same(loop: ClosedLoop, turns: InTurns) -> None:
    for i, env in enumerate(turns.envs):
        np.testing.assert_array_equal(loop.envs.records[i], env.records[0])
        np.testing.assert_array_equal(loop.envs.arrays.observations[i], env.arrays.observations[0])
        assert loop.envs.arrays.ends[i] == env.arrays.ends[0]


def traced(loop: ClosedLoop, periods: int, weights: Any = None, **more: Any) -> tuple[Tally, Array]:
    trace = np.full((loop.envs.num_envs, periods, k.RECORD_SIZE), np.nan)
    return loop.drive(periods, weights, trace=trace, **more), trace
