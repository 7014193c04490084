"""PPO of TorchRL on the compiled vector environment.

Prints the mean return of 10 s of T2 before and after. Needs `lpv-track-env[libraries]`.
"""

import argparse
from typing import Any

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, GymWrapper, set_exploration_type
from torchrl.envs.transforms import Compose, ObservationNorm, TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import lpv_track_env

FRAMES, EPOCHS, BATCHES = 4096, 6, 4
# Scalars, curvatures and speeds of an observation in units that make them about 1.
SCALE = torch.tensor([0.1, 1, 1, 0.2, 2, 1, 2, 0.1] + 20 * [10] + 20 * [0.1])


def make(count: int) -> TransformedEnv:
    """Make environments; TorchRL resets each within the step that ends its episode."""
    envs = gymnasium.make_vec(
        lpv_track_env.PATH_TRACKING, num_envs=count, vectorization_mode="vector_entry_point",
        trajectory="T2", random_start=True, time_limit=10.0, autoreset_mode="SameStep",
    )  # fmt: skip
    scale = ObservationNorm(torch.zeros(48), SCALE, in_keys=["observation"])
    return TransformedEnv(GymWrapper(envs), Compose(scale))


def mean_return(actor: ProbabilisticActor) -> float:
    """Drive 64 episodes with the mean action."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        drive = make(64).rollout(201, actor, break_when_any_done=False)["next"]
    ended = drive["done"].int().cumsum(1) - drive["done"].int()
    return float((drive["reward"] * (ended == 0)).sum(1).mean())


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=409_600)
    parser.add_argument("--envs", type=int, default=128)
    options = parser.parse_args()
    torch.manual_seed(0)
    envs = make(options.envs)
    space: Any = gymnasium.make(lpv_track_env.PATH_TRACKING).action_space
    bounds = {"low": torch.as_tensor(space.low), "high": torch.as_tensor(space.high)}
    body = MLP(out_features=4, num_cells=[64, 64], activation_class=nn.Tanh)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(body, NormalParamExtractor(scale_mapping="biased_softplus_0.4")),
            ["observation"], ["loc", "scale"],
        ),
        in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True,
        distribution_kwargs=bounds,
    )  # fmt: skip
    critic = ValueOperator(MLP(out_features=1, num_cells=[64, 64], activation_class=nn.Tanh))
    actor(envs.reset())
    critic(envs.reset())
    gains = GAE(gamma=0.97, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.001, critic_coeff=0.5)
    adam = torch.optim.Adam(loss.parameters(), lr=1e-3, eps=1e-5)
    print(f"mean return before: {mean_return(actor):.1f}")
    collector = Collector(
        envs, actor, frames_per_batch=FRAMES, total_frames=options.steps,
        auto_register_policy_transforms=True,
    )  # fmt: skip
    for data in collector:
        with torch.no_grad():
            gains(data)
        rows = data.reshape(-1)
        for part in (p for _ in range(EPOCHS) for p in torch.randperm(len(rows)).chunk(BATCHES)):
            parts = loss(rows[part])
            adam.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            adam.step()
    print(f"mean return after {options.steps} steps: {mean_return(actor):.1f}")


if __name__ == "__main__":
    main()
