"""PPO of skrl on the compiled vector environment.

Prints the mean return of 10 s of T2 before and after. Needs `lpv-track-env[libraries]`.
"""

import argparse
from typing import Any

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

import lpv_track_env

LENGTH = 32


def make(count: int) -> Any:
    """Make environments with actions in [-1, 1]."""
    envs = gymnasium.make_vec(
        lpv_track_env.PATH_TRACKING, num_envs=count, vectorization_mode="vector_entry_point",
        trajectory="T2", random_start=True, time_limit=10.0,
    )  # fmt: skip
    low, high = torch.full((2,), -1.0).numpy(), torch.full((2,), 1.0).numpy()
    return wrap_env(gymnasium.wrappers.vector.RescaleAction(envs, low, high))


def network(outputs: int) -> nn.Sequential:
    """Make a network from a scaled observation."""
    return nn.Sequential(
        nn.Linear(48, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )


class Actor(GaussianMixin, Model):
    """Normal distribution of actions with a spread of its own."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self, clip_actions=True)
        self.net, self.spread = network(2), nn.Parameter(torch.full((2,), -1.0))

    def compute(self, inputs: Any, role: str = "") -> Any:
        """Return the mean and the logarithm of the spread."""
        del role
        return self.net(inputs["observations"]), {"log_std": self.spread}


class Critic(DeterministicMixin, Model):
    """Value of an observation."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = network(1)

    def compute(self, inputs: Any, role: str = "") -> Any:
        """Return the value."""
        del role
        return self.net(inputs["observations"]), {}


@torch.no_grad()
def mean_return(agent: PPO) -> float:
    """Drive 64 episodes with the mean action."""
    envs = make(64)
    agent.enable_training_mode(False)
    seen, total, alive = envs.reset()[0], torch.zeros(64, 1), torch.ones(64, 1, dtype=torch.bool)
    while alive.any():
        action = agent.act(seen, None, timestep=0, timesteps=1)[1]["mean_actions"].clamp(-1, 1)
        seen, reward, terminated, truncated, _ = envs.step(action)
        total += reward * alive
        alive &= ~(terminated | truncated).bool()
    return float(total.mean())


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--envs", type=int, default=128)
    options = parser.parse_args()
    set_seed(0)
    envs = make(options.envs)
    spaces = {
        "observation_space": envs.observation_space, "action_space": envs.action_space,
        "state_space": None, "device": envs.device,
    }  # fmt: skip
    cfg = PPO_CFG(
        rollouts=LENGTH, learning_epochs=6, mini_batches=4, discount_factor=0.97,
        learning_rate=1e-3, value_loss_scale=0.5, time_limit_bootstrap=True,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": envs.observation_space, "device": envs.device},
    )  # fmt: skip
    cfg.experiment.write_interval = cfg.experiment.checkpoint_interval = 0
    models = {"policy": Actor(**spaces), "value": Critic(**spaces)}
    memory = RandomMemory(memory_size=LENGTH, num_envs=options.envs, device=envs.device)
    agent = PPO(models=models, memory=memory, cfg=cfg, **spaces)
    agent.init()
    print(f"mean return before: {mean_return(agent):.1f}")
    trainer_cfg = {
        "timesteps": options.steps // options.envs, "headless": True, "disable_progressbar": True,
        "close_environment_at_exit": False,
    }  # fmt: skip
    SequentialTrainer(env=envs, agents=agent, cfg=trainer_cfg).train()
    print(f"mean return after {options.steps} steps: {mean_return(agent):.1f}")


if __name__ == "__main__":
    main()
