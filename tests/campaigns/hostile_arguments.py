"""Arguments of wrong types and absurd values for every public class and function.

Each try gives one argument of one class a hostile value, in a forked child. It must be refused by a
ValueError or TypeError of one line, or be taken; then the object must work with finite numbers.
"""

import importlib
import inspect
import random
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from tests.campaigns import Counts, Say
from tests.helpers.forked import forked

SECONDS = 30.0
LONGEST = 1000
"""Characters of the longest message, lists of all known names included."""


class Raises:
    """Answers every question about itself with an exception."""

    def __float__(self) -> float:
        raise RuntimeError("__float__")

    def __repr__(self) -> str:
        raise RuntimeError("__repr__")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("__eq__")

    def __hash__(self) -> int:
        raise RuntimeError("__hash__")

    def __len__(self) -> int:
        raise RuntimeError("__len__")

    def __iter__(self) -> Iterator[Any]:
        raise RuntimeError("__iter__")

    def __bool__(self) -> bool:
        raise RuntimeError("__bool__")


class RaisingFloat(float):
    """A float whose conversions raise."""

    def __float__(self) -> float:
        raise RuntimeError("__float__")

    def __repr__(self) -> str:
        raise RuntimeError("__repr__")


def _tensor(value: Any, *, gradient: bool) -> Any:
    import torch

    return torch.tensor(value, requires_grad=gradient)


VALUES: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "True": lambda: True,
    "text": lambda: "abc",
    "empty text": lambda: "",
    "long text": lambda: "x\n" * 250_000,
    "bytes": lambda: b"abc",
    "nul": lambda: "a\0b",
    "surrogate": lambda: "\udcff",
    "0": lambda: 0,
    "1": lambda: 1,
    "-1": lambda: -1,
    "0.5": lambda: 0.5,
    "-0.5": lambda: -0.5,
    "10**12": lambda: 10**12,
    "10**400": lambda: 10**400,
    "2**63": lambda: 2**63,
    "1e8": lambda: 1e8,
    "1e308": lambda: 1e308,
    "1e-9": lambda: 1e-9,
    "5e-324": lambda: 5e-324,
    "nan": lambda: float("nan"),
    "inf": lambda: float("inf"),
    "-inf": lambda: float("-inf"),
    "complex": lambda: 1 + 2j,
    "float32": lambda: np.float32(0.1),
    "int64": lambda: np.int64(3),
    "float128": lambda: np.longdouble("1e4000"),
    "array of one": lambda: np.array(3.0),
    "array": lambda: np.array([1.0, 2.0, 3.0]),
    "array of objects": lambda: np.array([None, {}], dtype=object),
    "empty list": list,
    "list": lambda: [1, 2],
    "list of None": lambda: [None, None, None],
    "list of nan": lambda: [float("nan")] * 4,
    "nested": lambda: [[1.0], [2.0, [3.0]]],
    "deep": lambda: _deep(5000),
    "dict": dict,
    "dict of number": lambda: {1: 2},
    "set": lambda: {1, 2},
    "object": object,
    "class": lambda: dict,
    "function": lambda: len,
    "raises": Raises,
    "raising float": lambda: RaisingFloat(0.1),
    "tensor": lambda: _tensor(1.0, gradient=True),
    "tensors": lambda: _tensor([1.0, 2.0, 3.0], gradient=True),
}


def _deep(depth: int) -> list[Any]:
    nested: list[Any] = []
    for _ in range(depth):
        nested = [nested]
    return nested


class Target(NamedTuple):
    """A class or function: where it is, arguments that it needs, and how the result is used."""

    name: str
    needed: Mapping[str, Callable[[], Any]]
    use: Callable[[Any], None] = lambda _: None


def _drive(env: Any) -> None:
    """Drive an environment a little; everything it answers must be finite."""
    env.reset(seed=0)
    action = env.action_space.sample()
    for _ in range(3):
        observation, reward, terminated, truncated, _ = env.step(action)
        parts = observation.values() if isinstance(observation, dict) else [observation]
        if not all(np.isfinite(part).all() for part in (*parts, reward)):
            raise ArithmeticError("not finite")
        if np.any(terminated | truncated):
            return


def _conditions(conditions: Any) -> None:
    from lpv_track_env.env import PathTrackingEnv

    _drive(PathTrackingEnv("u-turn", conditions=conditions))


def _rewards(weights: Any) -> None:
    from lpv_track_env.env import PathTrackingEnv

    _drive(PathTrackingEnv("u-turn", reward_weights=weights))


def _env() -> Any:
    from lpv_track_env.env import PathTrackingEnv

    return PathTrackingEnv("u-turn")


def _vehicle() -> Any:
    from lpv_track_env.vehicle import VEHICLES

    return VEHICLES["m2-minibus"]


def _some(value: Any) -> Callable[[], Any]:
    return lambda: value


def _preset(name: str) -> Mapping[str, Callable[[], Any]]:
    import dataclasses

    from lpv_track_env.vehicle import VEHICLES

    made = VEHICLES[name]
    return {field.name: _some(getattr(made, field.name)) for field in dataclasses.fields(made)}


def _step(action: Any) -> Any:
    env = _env()
    env.reset(seed=0)
    return env.step(action)


def _reset(seed: Any = 0, **options: Any) -> Any:
    return _env().reset(seed=seed, options=options)


def _reset_options(options: Any) -> Any:
    return _env().reset(seed=0, options=options)


def _vector_step(actions: Any) -> Any:
    from lpv_track_env.vector_env import PathTrackingVectorEnv

    env = PathTrackingVectorEnv(2, trajectory="u-turn")
    env.reset(seed=0)
    return env.step(actions)


def _vector_reset(seed: Any = 0, options: Any = None) -> Any:
    from lpv_track_env.vector_env import PathTrackingVectorEnv

    return PathTrackingVectorEnv(2, trajectory="u-turn").reset(seed=seed, options=options)


def _computing_time(latency: Any = 0.01, occupied: Any = None) -> None:
    from lpv_track_env.env import PathTrackingEnv

    env = PathTrackingEnv("u-turn", conditions="ideal")
    env.reset(seed=0)
    env.set_computing_time(latency, occupied)
    _drive(env)


def _agent(name: Any = "stanley", delay_compensation: Any = None) -> None:
    import agents

    _act(agents.make(name, _env(), delay_compensation=delay_compensation))


def _act(agent: Any) -> None:
    action, _ = agent.predict(_env().reset(seed=0)[0])
    if not np.isfinite(action).all():
        raise ArithmeticError("not finite")


def _nmpc(settings: Any) -> None:
    """Solve once with the settings of an NMPC agent."""
    import dataclasses

    import agents

    given = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    _act(agents.make("lpv-nmpc", _env(), **given))


def _task() -> Any:
    from agents.base import DrivingTask

    return DrivingTask.of(_env())


def _problem() -> Any:
    from agents.nmpc.problem import NmpcProblem

    return NmpcProblem(_vehicle(), horizon=5)


def _policy() -> dict[str, Callable[[], Any]]:
    import dataclasses

    from agents.base import CHECKPOINTS
    from agents.learned.policy import read

    made = read(CHECKPOINTS / "bc.json")
    return {field.name: _some(getattr(made, field.name)) for field in dataclasses.fields(made)}


def _weight_policy() -> dict[str, Callable[[], Any]]:
    import dataclasses

    from agents.base import CHECKPOINTS
    from agents.weight_tuning.policy import read

    made = read(CHECKPOINTS / "lpv-nmpc-tuned-paired.json")
    return {field.name: _some(getattr(made, field.name)) for field in dataclasses.fields(made)}


def _bands() -> Any:
    from trajectories import CurvatureBands

    return CurvatureBands()


def _sets() -> Any:
    from agents.weights import TrackingWeights

    return (TrackingWeights(),) * len(_bands())


def _solve(solver: Any) -> None:
    """Solve once; what is found must be finite."""
    from agents.weights import WEIGHTS

    solution, _ = solver.solve(
        np.array([8.0, 0, 0, 0, 0, 0]), np.zeros(2), np.tile([8.0, 0, 0, 0], (6, 1)),
        np.ones(WEIGHTS),
    )  # fmt: skip
    if solution.inputs is not None and not np.isfinite(solution.inputs).all():
        raise ArithmeticError("not finite")


def _predict(agent: str, observation: Any, state: Any, episode_start: Any) -> None:
    """Call `predict` of an agent; the action must be finite."""
    import agents

    made = agents.make(agent, _env())
    action, _ = made.predict(observation, state, episode_start)
    if not np.isfinite(action).all():
        raise ArithmeticError("not finite")


def _observed() -> Any:
    return _env().reset(seed=0)[0]


def _predict_stanley(observation: Any, state: Any = None, episode_start: Any = None) -> None:
    _predict("stanley", observation, state, episode_start)


def _predict_nmpc(observation: Any, state: Any = None, episode_start: Any = None) -> None:
    _predict("lpv-nmpc", observation, state, episode_start)


def _predict_tuned(observation: Any, state: Any = None, episode_start: Any = None) -> None:
    _predict("lpv-nmpc-tuned", observation, state, episode_start)


def _predict_ppo(observation: Any, state: Any = None, episode_start: Any = None) -> None:
    _predict("ppo", observation, state, episode_start)


U_TURN = {"trajectory": _some("u-turn")}
TARGETS: tuple[Target, ...] = (
    Target("lpv_track_env.env:PathTrackingEnv", U_TURN, _drive),
    Target("lpv_track_env.vector_env:PathTrackingVectorEnv", U_TURN, _drive),
    Target("lpv_track_env.highway.env:HighwayTrackEnv", {}, _drive),
    Target("agents.weight_tuning.env:WeightTuningEnv", U_TURN),
    Target("agents.weight_tuning.env:WeightTuningVectorEnv", U_TURN),
    Target("lpv_track_env.conditions:Conditions", {}, _conditions),
    Target("lpv_track_env.conditions:load", {}),
    Target("lpv_track_env.estimation.estimator:EstimatorSettings", {}),
    Target("lpv_track_env.reward:RewardWeights", {}, _rewards),
    Target("lpv_track_env.observation:ObservationLayout", {}, lambda one: one.bound),
    Target("lpv_track_env.vehicle:VehicleParameters", _preset("m2-minibus")),
    Target("lpv_track_env.vehicle:load", {}),
    Target("lpv_track_env.highway.cruise:CruiseControl", {}),
    Target("lpv_track_env.highway.scenes:load", {}),
    Target("trajectories:SpeedLimits", {
        "max_speed": _some(10.0), "max_lateral_acceleration": _some(2.0),
        "max_acceleration": _some(1.5),
    }),
    Target("trajectories:random_path", {}),
    Target("trajectories.random_paths:limit_path", {}),
    Target("trajectories:load", {}),
    Target("trajectories:CurvatureBands", {}),
    Target("agents.weights:TrackingWeights", {}),
    Target("agents.weight_tuning.choice:WeightChoice", {}),
    Target("experiments.run.computing:ComputingTimes", {
        "arrangement": _some("sequential"), "estimation": _some(0.01), "control": _some(0.01),
        "period": _some(0.05),
    }, lambda one: one(0, 0.01)),
    Target(f"{__name__}:_step", {}),
    Target(f"{__name__}:_reset", {}),
    Target(f"{__name__}:_reset_options", {}),
    Target(f"{__name__}:_vector_step", {}),
    Target(f"{__name__}:_vector_reset", {}),
    Target(f"{__name__}:_computing_time", {}),
    Target(f"{__name__}:_agent", {}),
    Target("agents.nmpc.base:NmpcSettings", {}, _nmpc),
    Target("agents.base:DrivingTask", {
        name: (lambda name=name: getattr(_task(), name))  # type: ignore[misc]
        for name in ("layout", "vehicle", "control_period", "path")
    }),
    *(
        Target(f"agents.{name}", {"task": _task}, _act)
        for name in (
            "classical.geometric:Stanley", "classical.geometric:PurePursuit", "classical.pid:Pid",
            "classical.lqr:LpvLqr", "nmpc.rti_agent:RtiNmpc", "nmpc.ipopt_agent:IpoptNmpc",
            "nmpc.frozen:FrozenLpvMpc", "weight_tuning.agent:TunedNmpc", "learned.agent:Bc",
        )
    ),
    Target("agents.nmpc.problem:NmpcProblem", {"vehicle": _vehicle}),
    Target("agents.nmpc.rti_solver:RtiSolver", {"problem": _problem}, _solve),
    Target("agents.learned.policy:Policy", _policy()),
    Target("agents.learned.policy:read", {}),
    Target("agents.weight_tuning.policy:WeightPolicy", _weight_policy()),
    Target("agents.weight_tuning.policy:load", {}),
    Target("agents.weights:WeightSchedule", {
        "bands": _bands, "weights": _sets,
    }),
    Target("agents.weights:weights_from", {}),
    *(
        Target(f"{__name__}:_predict_{name}", {"observation": _observed})
        for name in ("stanley", "nmpc", "tuned", "ppo")
    ),
)  # fmt: skip


def callable_of(target: Target) -> Callable[..., Any]:
    """Return the class or function of a target."""
    module, _, name = target.name.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return found


def arguments_of(target: Target) -> list[str]:
    """Return the names of its arguments; reset options are among them."""
    extra = ["arc_length", "lateral_error", "speed_error", "speed", "trajectory", "vehicle"]
    return [
        *(
            name
            for name, one in inspect.signature(callable_of(target)).parameters.items()
            if one.kind is not one.VAR_KEYWORD
        ),
        *(extra if target.name.endswith(":_reset") else ()),
    ]


def every_try() -> list[tuple[Target, str, str]]:
    """Return all combinations of target, argument and value."""
    return [
        (target, argument, value)
        for target in TARGETS
        for argument in arguments_of(target)
        for value in VALUES
    ]


def attempt(target: Target, argument: str, value: str) -> int:
    """Make the object and use it; print what is wrong with an error and return 1, 0 if refused."""
    warnings.simplefilter("ignore")
    given = {name: make() for name, make in target.needed.items()}
    given[argument] = VALUES[value]()
    try:
        made = callable_of(target)(**given)
        target.use(made)
    except (ValueError, TypeError) as error:
        text = str(error)
        if "\n" in text or len(text) > LONGEST:
            print(f"message of {len(text)} characters, {text.count(chr(10))} line ends")
            return 1
        return 0
    return 3


def broken(target: Target, argument: str, value: str) -> tuple[str | None, str]:
    """Return what broke, or None, and the kind of outcome."""
    ended = forked(lambda: attempt(target, argument, value), SECONDS)
    name = f"{target.name}({argument}={value})"
    if ended.code in {0, 3}:
        return None, "refused" if ended.code == 0 else "taken"
    if ended.code is None:
        return f"{name}: hung for {SECONDS:g} s", "hung"
    words = (ended.err.strip() or ended.out.strip()).splitlines()
    return f"{name}: {words[-1][:200] if words else f'exit code {ended.code}'}", "broken"


def run(count: int, seed: int, say: Say) -> Counts:
    """Try `count` combinations, drawn without repetition; all of them if there are fewer."""
    from agents.nmpc.base import NmpcSettings

    tries = every_try()
    random.Random(seed).shuffle(tries)  # noqa: S311
    for target in TARGETS:
        # Compile in the parent, once.
        callable_of(target)
    _drive(_env())
    _nmpc(NmpcSettings())
    faults: list[str] = []
    seen = {"refused": 0, "taken": 0, "hung": 0, "broken": 0}
    for number, one in enumerate(tries[:count], start=1):
        fault, kind = broken(*one)
        seen[kind] += 1
        if fault is not None:
            faults.append(fault)
            say(fault)
        if number % 500 == 0:
            say(f"{number} of {min(count, len(tries))}")
    return Counts(min(count, len(tries)), faults, seen)
