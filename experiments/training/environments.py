"""What is trained on: random paths that no evaluation uses, under the settings' conditions."""

from collections.abc import Callable

import agents
import trajectories
from agents.learned.learner import LearnerVecEnv
from agents.learned.scaling import usual_scaling
from experiments.training.settings import TrainingSettings
from lpv_track_env import vehicle
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import ReferencePath

TRAINING_PATHS, VALIDATION_PATHS = 10_000_000, 20_000_000
"""Seeds of random paths from here on are training's and validation's; all below are neither's."""
PATHS_OF_A_SEED = 1000
TRAINING_EPISODES = 10**9
"""Seeds of episodes from here on are training's; evaluation counts from 0."""
INITIAL_ERRORS = (0.5, 0.1, 1.0)


def path_names(settings: TrainingSettings) -> list[str]:
    """Names of the paths of a training."""
    if settings.trajectories:
        return list(settings.trajectories)
    return random_names(TRAINING_PATHS + PATHS_OF_A_SEED * settings.seed, settings.paths)


def random_names(first: int, count: int) -> list[str]:
    """Names of random paths with seeds from `first` on, slow and fast ones in turn."""
    return [f"random-{'fast-' * (k % 2)}{first + k}" for k in range(count)]


def episode_seed(settings: TrainingSettings, segment: int) -> int:
    """Seed of the first environment in a segment; the others count on."""
    return TRAINING_EPISODES * (1 + settings.seed) + 1_000_000 * segment


def load_paths(
    settings: TrainingSettings, tick: Callable[[int, int], None] = lambda *_: None
) -> list[ReferencePath]:
    """Load the paths of a training; `tick(done, all)` after each."""
    names = path_names(settings)
    paths = []
    for k, name in enumerate(names):
        paths.append(trajectories.load(name))
        tick(k + 1, len(names))
    return paths


def make_learner_env(settings: TrainingSettings, paths: list[ReferencePath]) -> LearnerVecEnv:
    """Environments of a training, shared out among its conditions."""
    kinds, count = settings.conditions, settings.envs
    shares = [count // len(kinds) + (k < count % len(kinds)) for k in range(len(kinds))]
    envs = [
        PathTrackingVectorEnv(
            share, paths, vehicle.load(settings.vehicle), conditions=kind,
            control_period=settings.control_period, preview_steps=settings.preview_steps,
            preview_period=settings.preview_period, reward_weights=settings.reward_weights(),
            time_limit=settings.time_limit, initial_error_range=INITIAL_ERRORS, random_start=True,
            autoreset_mode="SameStep",
        )
        for kind, share in zip(kinds, shares, strict=True)
    ]  # fmt: skip
    scaling = usual_scaling(
        agents.DrivingTask.of(envs[0].single), settings.hyperparameters["origin"]
    )
    return LearnerVecEnv([agents.sb3_vec_env(env) for env in envs], scaling)
