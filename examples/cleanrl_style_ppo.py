"""PPO in one file, in the manner of CleanRL, on the compiled vector environment.

Prints the mean return of 10 s of T2 before and after. Needs `lpv-track-env[rl]` (torch).
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal

import lpv_track_env

LENGTH, EPOCHS, BATCHES, GAMMA, LAMBDA, CLIP = 32, 6, 4, 0.97, 0.95, 0.2
# Scalars, curvatures and speeds of an observation in units that make them about 1.
SCALE = np.array([0.1, 1, 1, 0.2, 2, 1, 2, 0.1] + 20 * [10] + 20 * [0.1], dtype=np.float32)


class Envs:
    """Environments in tensors, with actions in [-1, 1] and scaled observations."""

    def __init__(self, count: int) -> None:
        self.envs = gymnasium.make_vec(
            lpv_track_env.PATH_TRACKING, num_envs=count, vectorization_mode="vector_entry_point",
            trajectory="T2", random_start=True, time_limit=10.0, autoreset_mode="SameStep",
        )  # fmt: skip
        self.space: Any = self.envs.single_action_space
        self.seen = torch.as_tensor(self.envs.reset(seed=0)[0] * SCALE)

    def step(self, action: Tensor, critic: nn.Module | None = None) -> tuple[Tensor, Tensor]:
        """Return rewards, with the value of what a time limit cut off, and ends."""
        share = 0.5 + 0.5 * action.clamp(-1, 1).numpy()
        given = self.space.low + share * (self.space.high - self.space.low)
        seen, reward, terminated, truncated, infos = self.envs.step(given)
        self.seen = torch.as_tensor(seen * SCALE)
        if truncated.any() and critic is not None:
            last = torch.as_tensor(np.stack(infos["final_obs"][truncated]) * SCALE)
            reward[truncated] += GAMMA * critic(last)[:, 0].numpy()
        return torch.as_tensor(reward).float(), torch.as_tensor(terminated | truncated)


def network(outputs: int, scale: float) -> nn.Sequential:
    """Make a network whose first outputs are small."""
    last = nn.Linear(64, outputs)
    nn.init.orthogonal_(last.weight, scale)
    return nn.Sequential(nn.Linear(48, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), last)


@torch.no_grad()
def mean_return(actor: nn.Module) -> float:
    """Drive 64 episodes with the mean action."""
    envs, total, alive = Envs(64), torch.zeros(64), torch.ones(64, dtype=torch.bool)
    while alive.any():
        reward, ended = envs.step(actor(envs.seen))
        total += reward * alive
        alive &= ~ended
    return float(total.mean())


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--envs", type=int, default=128)
    options = parser.parse_args()
    torch.manual_seed(0)
    envs, actor, critic = Envs(options.envs), network(2, 0.01), network(1, 1.0)
    spread = nn.Parameter(torch.full((2,), -1.0))
    weights = [*actor.parameters(), *critic.parameters(), spread]
    adam = torch.optim.Adam(weights, lr=1e-3, eps=1e-5)
    print(f"mean return before: {mean_return(actor):.1f}")
    for _ in range(options.steps // (LENGTH * options.envs)):
        rows = []
        with torch.no_grad():
            for _ in range(LENGTH):
                seen, chosen = envs.seen, Normal(actor(envs.seen), spread.exp())
                action, value = chosen.sample(), critic(seen)[:, 0]
                rows.append((seen, action, chosen.log_prob(action).sum(1), value,
                             *envs.step(action, critic)))  # fmt: skip
            following, advantage = critic(envs.seen)[:, 0], torch.zeros(options.envs)
        seen, action, log, value, reward, ended = map(torch.stack, zip(*rows, strict=True))
        advantages = torch.zeros_like(reward)
        for t in reversed(range(LENGTH)):
            going = ~ended[t]
            delta = reward[t] + GAMMA * following * going - value[t]
            advantages[t] = advantage = delta + GAMMA * LAMBDA * advantage * going
            following = value[t]
        data = [x.flatten(0, 1) for x in (seen, action, log, advantages, advantages + value)]
        for part in (p for _ in range(EPOCHS) for p in torch.randperm(len(data[0])).chunk(BATCHES)):
            state, taken, before, gain, target = (x[part] for x in data)
            ratio = (Normal(actor(state), spread.exp()).log_prob(taken).sum(1) - before).exp()
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            better = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            loss = 0.5 * (critic(state)[:, 0] - target).square().mean() - better
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(weights, 0.5)
            adam.step()
    print(f"mean return after {options.steps} steps: {mean_return(actor):.1f}")


if __name__ == "__main__":
    main()
