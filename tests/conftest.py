"""Selection of tests: `slow` marks what `make test-fast` leaves out.

Folders and files that compile more than the environment's kernels, train, start processes or draw
are slow as a whole. In other files, slow tests are marked one by one.
"""

import os
import signal
from pathlib import Path

import pytest

from experiments.run.ray_session import LOOPBACK, QUIET

SLOW = (
    "agents/nmpc/test_f", "agents/nmpc/test_lin", "agents/nmpc/test_nmpc", "agents/nmpc/test_qp",
    "agents/nmpc/test_rti",
    "agents/test_agents", "agents/test_delay", "agents/test_sb3", "agents/learned",
    "agents/weight_tuning", "campaigns", "experiments/commands", "experiments/jobs",
    "experiments/comparison/test_compare_command", "experiments/comparison/test_known_difference",
    "experiments/parallel",
    "experiments/report/test_report_browser", "experiments/ros", "experiments/run/test_computing",
    "experiments/run/test_engines", "experiments/run/test_learning_cost",
    "experiments/run/test_ray_engine", "experiments/run/test_rollout", "experiments/speed",
    "experiments/study",
    "experiments/training", "experiments/tuning", "experiments/verify", "experiments/test_",
    "lpv_track_env/conditions/test_conditions_episode", "lpv_track_env/estimation",
    "lpv_track_env/highway", "lpv_track_env/test_plants", "lpv_track_env/test_rendering",
    "project/test_compiling", "project/test_docs", "project/test_examples",
    "trajectories/test_compilation", "trajectories/test_disk_cache",
)  # fmt: skip
"""Beginnings of paths below this folder."""


def pytest_configure() -> None:
    os.environ["LPV_TRACK_CACHE"] = "off"  # nothing of the tests is left in the user's cache
    os.environ.pop("COLUMNS", None)  # processes of pytest-xdist have 80, a pipe has 120
    # Ray reads them when it is imported, which a learning library may do before anybody else.
    os.environ.update(QUIET | LOOPBACK)
    # Whoever is started in the background ignores Ctrl-C, and so do the processes it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).as_posix().startswith(SLOW):
            item.add_marker(pytest.mark.slow)
