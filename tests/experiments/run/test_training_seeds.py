"""Several trainings of one agent in results: its label, and the seed of each training."""

import pytest

from experiments.run import tables


@pytest.mark.parametrize(
    ("agent", "settings", "label", "training"),
    [
        ("stanley", None, "stanley", None),
        ("results/ppo/seed-3/policy.json", {}, "results/ppo", 3),
        ("results/ppo/seed-999/policy.json", {"gain": 2}, "results/ppo (gain=2)", 999),
        ("seed-0/policy.json", {}, ".", 0),
        ("C:\\ppo\\seed-3\\policy.json", {}, "C:\\ppo", 3),
        ("lpv-nmpc-tuned", {"weights": "a/b/seed-12/weights.json"}, "a/b", 12),
        ("lpv-nmpc-tuned", {"weights": "b/seed-1/weights.json", "k": 1}, "b (k=1)", 1),
        ("lpv-nmpc", {"weights": "b/seed-1/weights.json"}, "lpv-nmpc (weights=b)", 1),
        ("lpv-nmpc-tuned", {"weights": "paired"}, "lpv-nmpc-tuned (weights=paired)", None),
        ("lpv-nmpc", {"weights": {"Q": [1]}}, "lpv-nmpc (weights={Q=[1]})", None),
        # Not as `train --seeds` names folders.
        ("ppo/seed-03/policy.json", {}, "ppo/seed-03/policy.json", None),
        ("ppo/seed-1000/policy.json", {}, "ppo/seed-1000/policy.json", None),
        ("ppo/seed-1/other.json", {}, "ppo/seed-1/other.json", None),
        ("ppo-seed-1/policy.json", {}, "ppo-seed-1/policy.json", None),
    ],
)
def test_trainings_in_folders_beside_each_other_are_one_agent(agent, settings, label, training):
    case = {"agent": agent, "agent_settings": settings}
    assert tables.label_of(case) == label
    assert tables.training_of(case) == training
