"""PPO, SAC, TD3 and the residual (PPO on top of the NMPC) by Stable-Baselines3.

Hyperparameters (`--set`), besides the network's `hidden` widths and `activation` and the `origin`
("zero", "actuators", "lpv-nmpc") that actions are added to:

PPO (Schulman et al. 2017): `learning_rate`, `last_learning_rate`; `rollout` steps of every
environment between updates, `epochs` over them in batches of `batch`; `discount`, `gae_lambda`,
`clip_range`; `deviation` of the first policy's actions in [-1, 1].

SAC (Haarnoja et al. 2018) and TD3 (Fujimoto et al. 2018): `buffer` transitions, `batch`,
`gradient_steps` after every step of the environments, `learning_starts` steps before the first,
`discount`, `target_rate` (tau); `noise` of TD3's actions.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise

from agents.learned.learner import LearnerVecEnv
from agents.learned.policy import Policy
from experiments.training.settings import TrainingSettings
from experiments.training.trainer import MODULES, Tick, Trainer, check_start, put_layers

KEPT = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of SB3's replay buffer that a checkpoint keeps."""


class _Progress(BaseCallback):
    """Reports the progress of a segment after every rollout."""

    def __init__(self, tick: Tick) -> None:
        super().__init__()
        self._tick = tick

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        ended = self.model.ep_info_buffer
        words = f"reward {np.mean([episode['r'] for episode in ended]):.1f}" if ended else ""
        self._tick(self.model.num_timesteps, words)


class Sb3Trainer(Trainer):
    """Training by calls of SB3's `learn`, one a segment."""

    def __init__(
        self, settings: TrainingSettings, env: LearnerVecEnv, start: Policy | None, logger: Logger
    ) -> None:
        super().__init__(settings, env)
        self._solves = 0
        self._started = start is not None
        self.model = self._make()
        self.device = self.model.device
        self.model.set_logger(logger)
        if start is not None:
            check_start(start, settings, env, squash=self._squash)
            put_layers(start.layers, self._actor_layers())

    @property
    def _squash(self) -> str:
        return "clip" if isinstance(self.model, PPO) else "tanh"

    def _make(self) -> PPO | SAC | TD3:
        hyper, settings = self.hyper, self.settings
        common: dict[str, Any] = {
            "learning_rate": lambda _: self.rate() if hasattr(self, "model") else 0.0,
            "gamma": hyper["discount"],
            "device": settings.device,
            "seed": settings.seed,
            "policy_kwargs": {
                "net_arch": list(hyper["hidden"]),
                "activation_fn": MODULES[hyper["activation"]],
            },
        }
        if settings.algorithm in {"ppo", "residual"}:
            common["policy_kwargs"]["log_std_init"] = float(np.log(hyper["deviation"]))
            return PPO(
                "MlpPolicy", self.env, n_steps=hyper["rollout"], batch_size=hyper["batch"],
                n_epochs=hyper["epochs"], gae_lambda=hyper["gae_lambda"],
                clip_range=hyper["clip_range"], **common,
            )  # fmt: skip
        common |= {
            "buffer_size": hyper["buffer"], "batch_size": hyper["batch"], "train_freq": 1,
            "gradient_steps": hyper["gradient_steps"], "tau": hyper["target_rate"],
            "learning_starts": hyper["learning_starts"],
        }  # fmt: skip
        if settings.algorithm == "sac":
            return SAC("MlpPolicy", self.env, **common)
        noise = NormalActionNoise(np.zeros(2), np.full(2, hyper["noise"]))
        return TD3("MlpPolicy", self.env, action_noise=noise, **common)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.model.num_timesteps)

    @property
    def solves(self) -> int:
        """NMPC solves so far, by the residual's base."""
        return self._solves + self.env.solves

    def segment(self, number: int, tick: Tick) -> dict[str, float]:
        """Learn to the end of a segment."""
        self.begin_segment(number)
        if self.model.ep_info_buffer is not None:
            self.model.ep_info_buffer.clear()
        # An untrained value function would ruin a policy to start from: it is fitted alone first.
        frozen = self._actor_parameters() if self._started and number == 0 else []
        for parameter in frozen:
            parameter.requires_grad_(False)
        self.model.set_env(self.env, force_reset=True)
        self.model.learn(
            max(self.settings.end_of(number) - self.steps, 1),
            callback=_Progress(tick), reset_num_timesteps=False, log_interval=10,
        )  # fmt: skip
        for parameter in frozen:
            parameter.requires_grad_(True)
        ended = self.model.ep_info_buffer
        return {"reward": float(np.mean([episode["r"] for episode in ended]))} if ended else {}

    def _actor_layers(self) -> list[torch.nn.Linear]:
        """Return the layers from features to actions."""
        policy: Any = self.model.policy
        if isinstance(self.model, PPO):
            parts = [*policy.mlp_extractor.policy_net, policy.action_net]
        elif isinstance(self.model, SAC):
            parts = [*policy.actor.latent_pi, policy.actor.mu]
        else:
            parts = [*policy.actor.mu]
        return [part for part in parts if isinstance(part, torch.nn.Linear)]

    def _actor_parameters(self) -> list[torch.nn.Parameter]:
        if not isinstance(self.model, PPO):
            return []
        own = [p for layer in self._actor_layers() for p in layer.parameters()]
        return [*own, self.model.policy.log_std]

    def state(self) -> dict[str, Any]:
        """Return networks, optimisers, counters and, for SAC and TD3, the replay buffer."""
        model: Any = self.model
        state = {
            "parameters": model.get_parameters(),
            "steps": self.steps,
            "updates": model._n_updates,  # noqa: SLF001  counts the delays of TD3
            "solves": self.solves,
        }
        if getattr(model, "log_ent_coef", None) is not None:
            state["entropy"] = model.log_ent_coef.detach().clone()
        if not isinstance(model, PPO):
            buffer: ReplayBuffer = model.replay_buffer
            filled = buffer.buffer_size if buffer.full else buffer.pos
            state["buffer"] = {
                "pos": buffer.pos,
                "full": buffer.full,
                **{name: torch.from_numpy(getattr(buffer, name)[:filled]) for name in KEPT},
            }
        return state

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a state."""
        model: Any = self.model
        model.set_parameters(state["parameters"], exact_match=True)
        model.num_timesteps, model._n_updates = state["steps"], state["updates"]  # noqa: SLF001
        self._solves = state["solves"] - self.env.solves
        if "entropy" in state:
            model.log_ent_coef.data.copy_(state["entropy"])
        if "buffer" in state:
            buffer, stored = model.replay_buffer, state["buffer"]
            for name in KEPT:
                getattr(buffer, name)[: len(stored[name])] = stored[name].numpy()
            buffer.pos, buffer.full = stored["pos"], stored["full"]

    def policy(self, training: Mapping[str, Any]) -> Policy:
        """Return the deterministic policy."""
        return self.env.policy_of(self.model, self.settings.algorithm, training)
