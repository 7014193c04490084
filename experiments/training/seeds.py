"""What is trained on, validated on, and left for evaluation: by seeds that never meet."""

from experiments.training.settings import MOST_PATHS, TrainingSettings

TRAINING_PATHS, VALIDATION_PATHS = 10_000_000, 20_000_000
"""Seeds of random paths from here on are training's and validation's; all below are neither's."""
VALIDATION_EPISODES, TRAINING_EPISODES = 2 * 10**8, 10**9
"""Seeds of episodes from here on are validation's and training's; evaluation counts from 0.

Under one seed a vehicle draws the same disturbances on every path.
"""


def path_names(settings: TrainingSettings) -> list[str]:
    """Names of the paths of a training."""
    if settings.trajectories:
        return list(settings.trajectories)
    return random_names(TRAINING_PATHS + MOST_PATHS * settings.seed, settings.paths)


def validation_names(settings: TrainingSettings) -> list[str]:
    """Names of the paths that a policy is chosen on: random ones, or one's own as in training."""
    if settings.trajectories:
        return list(settings.trajectories[: settings.validation])
    return random_names(VALIDATION_PATHS, settings.validation)


def random_names(first: int, count: int) -> list[str]:
    """Names of random paths with seeds from `first` on, slow and fast ones in turn."""
    return [f"random-{'fast-' * (k % 2)}{first + k}" for k in range(count)]


def episode_seed(settings: TrainingSettings, segment: int) -> int:
    """Seed of the first environment in a segment; the others count on."""
    return TRAINING_EPISODES * (1 + settings.seed) + 1_000_000 * segment
