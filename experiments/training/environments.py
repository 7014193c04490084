"""What is trained on: random paths that no evaluation uses, under the settings' conditions."""

from collections.abc import Callable

import agents
import trajectories
from agents.learned.learner import LearnerVecEnv, usual_scaling
from experiments.training.seeds import path_names
from experiments.training.settings import TrainingSettings
from lpv_track_env import vehicle
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import ReferencePath

INITIAL_ERRORS = (0.5, 0.1, 1.0)


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
