"""Machine code is compiled once and kept on disk: later processes compile nothing."""

import dis
import importlib
import json
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType

from numba.core.dispatcher import Dispatcher

from trajectories.compilation import Threaded, _Internal

PACKAGES = ("trajectories", "lpv_track_env", "agents", "experiments")

USES = """
import json
from numba.core import event

compiled = []

class Spy(event.Listener):
    def on_start(self, started):
        compiled.append(str(started.data["dispatcher"]))

    def on_end(self, ended):
        pass

event.register("numba:compile", Spy())

import gymnasium
import numpy as np
import agents
import lpv_track_env
import trajectories
from lpv_track_env.conditions.sensors import Sensors
from lpv_track_env.conditions import REALTIME
from lpv_track_env.vector_env import PathTrackingVectorEnv

path = trajectories.load("T2")
path.sample([1.0, 2.0])
path.project(1.0, 2.0)
path.project(1.0, 2.0, near=3.0)
path.preview(0.0, 0.05, 20)
path.arc_length_at(1.0)
sensors = Sensors(REALTIME)
sensors.inertial(0.0, 0.0, 0.0), sensors.wheel_speed(1.0), sensors.fix(0.0, 0.0, 0.0)
for conditions in ("simulation", "realtime"):
    for threads in (1, 2):
        many = PathTrackingVectorEnv(3, conditions=conditions, threads=threads)
        many.reset(seed=0)
        many.step(many.action_space.sample())
    env = gymnasium.make(lpv_track_env.PATH_TRACKING, conditions=conditions)
    observation, _ = env.reset(seed=0)
    env.step(env.action_space.sample())
    for name in agents.names():
        agent = agents.make(name, env.unwrapped)
        agent.predict(observation, episode_start=np.array([True]))
print(json.dumps(compiled))
"""


def test_a_second_process_compiles_nothing() -> None:
    runs = [
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", USES], capture_output=True, text=True,
            timeout=400, check=False,
        )
        for _ in range(2)
    ]  # fmt: skip
    assert [run.returncode for run in runs] == [0, 0], runs[-1].stderr
    assert json.loads(runs[1].stdout) == []


def codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes(constant)


def loaded(function: FunctionType) -> Iterator[object]:
    """Globals that a Python function loads, and attributes of modules."""
    for code in codes(function.__code__):
        owner: object = None
        for instruction in dis.get_instructions(code):
            found = None
            if instruction.opname in {"LOAD_GLOBAL", "LOAD_NAME"}:
                found = function.__globals__.get(instruction.argval)
            elif isinstance(owner, ModuleType) and instruction.opname.startswith("LOAD_"):
                found = getattr(owner, instruction.argval, None)
            owner = found
            yield found


def unwrapped(value: object) -> object:
    for name in ("fget", "func", "__func__", "__wrapped__"):
        if not isinstance(value, Dispatcher | Threaded):
            value = getattr(value, name, value)
    return value


def functions(module: ModuleType) -> Iterator[FunctionType]:
    for owner in (module, *(one for one in vars(module).values() if isinstance(one, type))):
        if getattr(owner, "__module__", module.__name__) != module.__name__:
            continue
        for value in map(unwrapped, list(vars(owner).values())):
            if isinstance(value, FunctionType) and value.__module__ == module.__name__:
                yield value


def test_python_calls_no_function_without_an_entry_point() -> None:
    """Such a call compiles one in every process, which nothing keeps on disk."""
    seen, calls = 0, []
    for package in map(importlib.import_module, PACKAGES):
        found = [
            one.name for one in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        ]
        for name in (package.__name__, *(one for one in found if not one.endswith("__main__"))):
            for function in functions(importlib.import_module(name)):
                seen += 1
                calls += [
                    f"{name}: {function.__qualname__} calls {one.py_func.__name__}"
                    for one in loaded(function)
                    if isinstance(one, _Internal)
                ]
    assert seen > 1000
    assert calls == []
