"""Behaviour cloning of `lpv-nmpc` with DAgger (Ross, Gordon, Bagnell 2011).

In each round the expert drives some of the environments and the present policy the others. At
every step the expert's action is recorded, and after the round the network is fitted by least
squares to all actions recorded so far. Hyperparameters (`--set`): `learning_rate`,
`last_learning_rate`; `round` steps of every environment, then `updates` of Adam with `batch`
samples each; `expert_share` of the environments that the expert drives (all of them in the first
round); `noise`, the amplitude of uniform noise on the actions in half of the environments;
`hidden`, `activation`, `origin` as for PPO.
"""

from collections.abc import Mapping
from dataclasses import fields
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import get_device

from agents.learned.learner import LearnerVecEnv
from agents.learned.policy import Policy
from agents.nmpc.rti_agent import RtiNmpc
from experiments.training.settings import TrainingSettings
from experiments.training.trainer import MODULES, Tick, Trainer, check_start, put_layers

Array = NDArray[Any]


class CloningTrainer(Trainer):
    """Rounds of driving, recording the expert's actions, and fitting."""

    def __init__(
        self, settings: TrainingSettings, env: LearnerVecEnv, start: Policy | None, logger: Logger
    ) -> None:
        super().__init__(settings, env)
        self._logger = logger
        torch.manual_seed(settings.seed)
        widths = [env.scaling.features, *self.hyper["hidden"], 2]
        self._linear = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
        parts: list[torch.nn.Module] = []
        for layer in self._linear:
            parts += [layer, MODULES[self.hyper["activation"]]()]
        self.device = get_device(settings.device)
        self._net = torch.nn.Sequential(*parts[:-1]).to(self.device)
        if start is not None:
            check_start(start, settings, env, squash="clip")
            put_layers(start.layers, self._linear)
        self._experts = [RtiNmpc(task) for task in env.tasks]
        self._features = np.zeros((0, env.scaling.features), dtype=np.float32)
        self._labels = np.zeros((0, 2), dtype=np.float32)
        self._optimiser = torch.optim.Adam(self._net.parameters(), lr=self.rate())

    @property
    def steps(self) -> int:
        """Environment steps so far, each with an action of the expert."""
        return len(self._features)

    @property
    def solves(self) -> int:
        """Solves of the expert so far."""
        return len(self._features)

    def segment(self, number: int, tick: Tick) -> dict[str, float]:
        """Run rounds up to the end of a segment."""
        self.begin_segment(number)
        loss = 0.0
        while self.steps < self.settings.end_of(number):
            self._drive()
            loss = self._fit()
            self._logger.record("train/loss", loss)
            self._logger.record("train/learning_rate", self.rate())
            self._logger.dump(self.steps)
            tick(self.steps, f"loss {loss:.2e}")
        return {"loss": loss}

    def _drive(self) -> None:
        """Reset every environment and drive it for `round` steps."""
        n = self.env.num_envs
        features: Array = self.env.reset()
        memories: list[Any] = [None] * len(self._experts)
        actions, starts = np.zeros((n, 2)), np.ones(n, dtype=np.bool_)
        by_expert = self.random.random(n) < (1.0 if not self.steps else self.hyper["expert_share"])
        noise = self.hyper["noise"] * (self.random.random(n) < 0.5)
        inputs: list[Array] = [self._features]
        labels: list[Array] = [self._labels]
        for _ in range(self.hyper["round"]):
            seen, scaling = self.env.agent_observations, self.env.scaling
            for k, (expert, rows) in enumerate(zip(self._experts, self.env.rows, strict=True)):
                actions[rows], memories[k] = expert.predict(seen[rows], memories[k], starts[rows])
            wanted = (actions - self.env.origins - scaling.centre) / self.env.halves
            wanted = np.clip(wanted, -1.0, 1.0).astype(np.float32)
            inputs.append(features)
            labels.append(wanted)
            outputs = np.where(by_expert[:, None], wanted, self._outputs(features))
            outputs += noise[:, None] * self.random.uniform(-1.0, 1.0, outputs.shape)
            self.env.step_async(outputs)
            features, _, starts, _ = self.env.step_wait()
        self._features, self._labels = np.concatenate(inputs), np.concatenate(labels)

    def _outputs(self, features: Array) -> Array:
        with torch.no_grad():
            outputs: Array = self._net(torch.from_numpy(features).to(self.device)).cpu().numpy()
        return outputs

    def _fit(self) -> float:
        """Fit the network to all labels by Adam; return the mean loss of the last updates."""
        for group in self._optimiser.param_groups:
            group["lr"] = self.rate()
        inputs, targets = (
            torch.from_numpy(values).to(self.device) for values in (self._features, self._labels)
        )
        updates, losses = self.hyper["updates"], []
        for _ in range(updates):
            rows = torch.randint(len(inputs), (self.hyper["batch"],), device=self.device)
            loss = torch.nn.functional.mse_loss(self._net(inputs[rows]), targets[rows])
            self._optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimiser.step()
            losses.append(loss.item())
        return float(np.mean(losses[-max(updates // 10, 1) :]))

    def state(self) -> dict[str, Any]:
        """Return the network, the optimiser, and all features and labels."""
        return {
            "network": self._net.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "asked": torch.from_numpy(self._features),
            "said": torch.from_numpy(self._labels),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a state."""
        self._net.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._features, self._labels = state["asked"].numpy(), state["said"].numpy()

    def policy(self, training: Mapping[str, Any]) -> Policy:
        """Return the present policy."""
        scaling = self.env.scaling
        layers = tuple(
            (layer.weight.detach().cpu().numpy().copy(), layer.bias.detach().cpu().numpy().copy())
            for layer in self._linear
        )
        return Policy(
            algorithm=self.settings.algorithm, layout=self.env.task.layout,
            control_period=self.settings.control_period, layers=layers,
            activation=self.hyper["activation"], squash="clip", training=training,
            symmetric=True,
            **{item.name: getattr(scaling, item.name) for item in fields(scaling)},
        )  # fmt: skip
