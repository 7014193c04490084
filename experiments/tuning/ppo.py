"""Weight policies by PPO (Schulman et al. 2017; Stable-Baselines3), in segments that can resume.

A segment depends only on networks, optimiser and counters, and on (seed, segment): at its beginning
all random generators are seeded anew and all episodes restart. A resumed tuning therefore equals an
uninterrupted one.
"""

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO

from agents.weight_tuning.env import WeightTuningVectorEnv
from agents.weight_tuning.features import subset_mask
from agents.weight_tuning.learner import WeightLearnerVecEnv
from agents.weight_tuning.policy import WeightPolicy
from experiments.jobs import checkpoint
from experiments.jobs.job import episode_seed
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Tuner, choice_of, threads
from lpv_track_env import vehicle
from trajectories import ReferencePath


class PolicyLearning(Tuner):
    """PPO on `WeightTuning-v0`, starting from the default weights."""

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        torch.set_num_threads(1)
        self.choice = choice_of(settings)
        self.hyper = settings.hyperparameters
        envs = WeightTuningVectorEnv(
            settings.drives, paths, vehicle.load(settings.vehicle), conditions=settings.conditions,
            control_period=settings.control_period, choice=self.choice,
            preview_steps=settings.preview_steps, preview_period=settings.preview_period,
            time_limit=settings.time_limit, random_start=True, autoreset_mode="SameStep",
            threads=threads(),
        )  # fmt: skip
        self.env = WeightLearnerVecEnv(envs, subset_mask(settings.view, self.choice.bands.names))
        self._before, self._segment = 0, 0
        hyper = self.hyper
        self.model = PPO(
            "MlpPolicy", self.env, learning_rate=self._rate, n_steps=hyper["rollout"],
            batch_size=hyper["batch"], n_epochs=hyper["epochs"], gamma=hyper["discount"],
            gae_lambda=hyper["gae_lambda"], clip_range=hyper["clip_range"], seed=settings.seed,
            device="cpu", policy_kwargs=self._network(),
        )  # fmt: skip
        if self.choice.catalogue:
            # Begin with the default set, which is the first of the catalogue.
            with torch.no_grad():
                self.model.policy.action_net.bias[0] = 2.0  # type: ignore[operator]

    def _network(self) -> dict[str, Any]:
        network: dict[str, Any] = {
            "net_arch": list(self.hyper["hidden"]), "activation_fn": torch.nn.Tanh,
        }  # fmt: skip
        if not self.choice.catalogue:
            network["log_std_init"] = float(np.log(self.hyper["deviation"]))
        return network

    def _rate(self, _: float) -> float:
        """Return the present learning rate, linear in the solves."""
        first, last = self.hyper["learning_rate"], self.hyper["last_learning_rate"]
        share = min(self.solves / self.settings.solves, 1.0) if hasattr(self, "model") else 0.0
        return float(first + share * (last - first))

    @property
    def rollout(self) -> int:
        """Largest number of solves of a rollout."""
        steps = round(self.settings.window / self.settings.control_period)
        return int(self.settings.drives * self.hyper["rollout"] * max(steps, 1))

    @property
    def solves(self) -> int:
        """NMPC solves so far."""
        return self._before + self.env.solves

    @property
    def cost(self) -> int:
        """Largest number of solves of a rollout."""
        return self.rollout

    def step(self) -> dict[str, float]:
        """Run one segment: rollouts and updates until the next would exceed its solves."""
        settings, number = self.settings, self._segment
        seed = int(np.random.SeedSequence((settings.seed, number)).generate_state(1)[0])
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  where SB3 draws from
        torch.manual_seed(seed)
        self.env.seed(episode_seed(settings.seed, number))
        self.model.set_env(self.env, force_reset=True)
        end = min((number + 1) * self.hyper["segment"], settings.solves)
        rewards: list[float] = []
        # At least one rollout: a segment shorter than one would never end.
        while not rewards or self.solves + self.rollout <= end:
            steps = settings.drives * self.hyper["rollout"]
            self.model.learn(steps, reset_num_timesteps=False, log_interval=None)  # type: ignore[arg-type]
            rewards.append(float(self.model.rollout_buffer.rewards.mean()))
        self._segment += 1
        return {"score": -float(np.mean(rewards)), "best": -float(np.max(rewards))}

    def layers(self) -> list[tuple[Any, Any]]:
        """Return the layers (W, b) from features to outputs."""
        policy: Any = self.model.policy
        parts = [*policy.mlp_extractor.policy_net, policy.action_net]
        return [
            (part.weight.detach().numpy().copy(), part.bias.detach().numpy().copy())
            for part in parts
            if isinstance(part, torch.nn.Linear)
        ]

    def result(self, provenance: Mapping[str, Any]) -> WeightPolicy:
        """Return the policy that takes the mean action, or the likeliest set."""
        return self.env.policy_of(self.layers(), self.settings.method, provenance)

    def save(self, folder: Path) -> None:
        """Write networks, optimiser and counters."""
        checkpoint.write(
            folder,
            {
                "parameters": self.model.get_parameters(), "solves": self.solves,
                "segment": self._segment, "steps": int(self.model.num_timesteps),
                "updates": int(self.model._n_updates),  # noqa: SLF001
            },
        )  # fmt: skip

    def read_state(self, folder: Path) -> bool:
        """Read the state that `save` wrote; False if there is none."""
        kept = checkpoint.read(folder)
        if kept is None:
            return False
        try:
            self.model.set_parameters(kept["parameters"], exact_match=True)
            self._before = int(kept["solves"]) - self.env.solves
            self._segment = int(kept["segment"])
            self.model.num_timesteps = int(kept["steps"])
            self.model._n_updates = int(kept["updates"])  # noqa: SLF001
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            # PyTorch writes a line for every layer that does not fit.
            reason = str(error).split("\n", 1)[0]
            raise ValueError(
                f"{folder / checkpoint.NAME} is of another training ({reason}): remove it, and the "
                "tuning begins anew"
            ) from None
        return True
