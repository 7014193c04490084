"""ONNX models of learned policies, for whatever runs such models: needs `lpv-track-env[export]`.

A model has the input `observation` (n, size) float32 in SI units, for origin "lpv-nmpc" also `base`
(n, 2), that agent's action on it, and the output `action` (n, 2): m/s^2 and rad, within the bounds
of the vehicle. Scaling, context and symmetry are inside. Its metadata describe all of this.

Two things stay with the caller. Observations must be finite. And a policy with context sees the
reference that its vehicle can follow: `agents.learned.context.Followed` replaces the previews,
which changes something where friction is limited or the vehicle is much slower than the reference.
"""

import json
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from agents.base import DrivingTask
from agents.learned.context import context_of, with_context
from agents.learned.network import Network
from agents.learned.policy import ACTIONS, Policy
from lpv_track_env.observation import ACCELERATION, PREVIEW_START, SCALARS

OPSET, IR_VERSION = 17, 8
"""Versions that runtimes have known since 2022."""


class _Graph:
    """Nodes and constants of a model in the making."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, values: Any) -> str:
        name = f"c{len(self.constants)}"
        array = np.array(values, dtype=np.int64 if isinstance(values, list) else np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def add(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        output = output or f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def clip(self, x: str, low: Any, high: Any, output: str | None = None) -> str:
        return self.add("Min", self.add("Max", x, self.constant(low)), self.constant(high),
                        output=output)  # fmt: skip

    def dense(self, x: str, weight: NDArray[Any], bias: NDArray[Any]) -> str:
        return self.add("Gemm", x, self.constant(weight), self.constant(bias), transB=1)


def model_of(policy: Policy, task: DrivingTask) -> Any:
    """Return the `onnx.ModelProto` of a policy that drives a task."""
    given, graph = with_context(policy, task), _Graph()
    low, high = task.action_bounds
    size = policy.layout.size
    bound = policy.layout.bound.astype(np.float32)
    seen = graph.clip("observation", -bound, bound)
    names = [("observation", size)]
    base = ""
    if policy.origin == "actuators":
        starts, ends = graph.constant([ACCELERATION]), graph.constant([ACCELERATION + ACTIONS])
        base = graph.add("Slice", seen, starts, ends, graph.constant([1]))
    elif policy.origin == "lpv-nmpc":
        names.append(("base", ACTIONS))
        base, seen = "base", graph.add("Concat", seen, "base", axis=1)
    output = _pass(graph, given, seen)
    if policy.symmetric:
        mirrored = _pass(graph, given, graph.add("Mul", seen, graph.constant(given.mirror)))
        back = graph.add("Mul", mirrored, graph.constant(np.array([1.0, -1.0])))
        half = graph.constant(np.float32(0.5))
        output = graph.add("Mul", graph.add("Add", output, back), half)
    change = graph.add("Mul", output, graph.constant(given.half))
    change = graph.add("Add", change, graph.constant(given.centre))
    graph.clip(graph.add("Add", base, change) if base else change, low, high, output="action")
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", k]) for name, k in names]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", ACTIONS])]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "policy", inputs, outputs, graph.constants),
        producer_name="lpv-track-env", ir_version=IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )  # fmt: skip
    helper.set_model_props(model, metadata(policy, task))
    onnx.checker.check_model(model)
    return model


def _pass(graph: _Graph, policy: Policy, inputs: str) -> str:
    """Add one pass through the network; return the name of its output in [-1, 1]."""
    limit = np.float32(policy.feature_limit)
    x = graph.dense(inputs, policy.feature_weight, policy.feature_bias)
    x = graph.clip(x, -limit, limit)
    for weight, bias in policy.layers[:-1]:
        x = graph.add(policy.activation.capitalize(), graph.dense(x, weight, bias))
    x = graph.dense(x, *policy.layers[-1])
    if policy.squash == "tanh":
        return graph.add("Tanh", x)
    return graph.clip(x, np.float32(-1.0), np.float32(1.0))


def metadata(policy: Policy, task: DrivingTask) -> dict[str, str]:
    """Return what a user of the model must know; values that are not texts are JSON."""
    layout, car = policy.layout, task.vehicle
    steps = layout.preview_steps
    entries: list[tuple[str, str, int]] = [(name, unit, 1) for name, unit, _ in SCALARS]
    entries += [("preview_curvature", "1/m", steps), ("preview_speed", "m/s", steps)]
    assert sum(count for *_, count in entries) == PREVIEW_START + 2 * steps
    low, high = task.action_bounds
    context = dict(zip(policy.context, context_of(policy.context, task).tolist(), strict=True))
    words = {
        "algorithm": policy.algorithm,
        "origin": policy.origin,
        "observation": [["name", "unit", "entries"], *entries],
        "observation_digest": layout.digest,
        "preview_period_s": layout.preview_period,
        "action": ["acceleration m/s^2", "steering_angle rad, left positive"],
        "action_low": low.tolist(),
        "action_high": high.tolist(),
        "control_period_s": policy.control_period,
        "vehicle": car.name,
        "context": context,
        "reference": "that the vehicle can follow" if context else "as observed",
        "trained_on": policy.training.get("vehicle", ""),
    }
    return {
        key: value if isinstance(value, str) else json.dumps(value) for key, value in words.items()
    }


def difference(policy: Policy, task: DrivingTask, model: Any, count: int = 1000) -> float:
    """Return the largest difference of an action, m/s^2 or rad, on random observations.

    The model runs in ONNX Runtime, the policy in the agent's own compiled code.
    """
    import onnxruntime

    rng, layout = np.random.default_rng(0), policy.layout
    scale = np.full(layout.size, 10.0)
    scale[:PREVIEW_START] = 10.0, 0.5, 0.5, 2.0, 0.3, 1.0, 0.3, 10.0
    scale[PREVIEW_START : PREVIEW_START + layout.preview_steps] = 0.1
    seen = (scale * rng.standard_normal((count, layout.size))).astype(np.float32)
    low, high = task.action_bounds
    base = rng.uniform(low, high, (count, ACTIONS)).astype(np.float32)
    actions = base.astype(np.float64)
    Network.of(with_context(policy, task), low, high).act(seen.astype(np.float64), actions)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    inputs = {"observation": seen} | ({"base": base} if policy.origin == "lpv-nmpc" else {})
    [found] = session.run(None, inputs)
    return float(np.abs(found - actions).max())
