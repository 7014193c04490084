"""What is trained on, validated on, and left for evaluation: by seeds that never meet."""

from experiments.training.settings import TrainingSettings

TRAINING_PATHS, VALIDATION_PATHS = 10_000_000, 20_000_000
"""Seeds of random paths from here on are training's and validation's; all below are neither's."""
PATHS_OF_A_SEED = 1000
TRAINING_EPISODES = 10**9
"""Seeds of episodes from here on are training's; evaluation counts from 0."""


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
