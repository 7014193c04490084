"""Racelines with speeds of their own, driven in closed loop."""

from pathlib import Path

import numpy as np
import pytest

from experiments.run.case import run_case
from lpv_track_env.reference import SpeedChoice, reference
from lpv_track_env.vehicle import load
from trajectories import load as load_path

HEADER = "s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2"
LAP = 59.0
"""s."""


@pytest.fixture(scope="module")
def raceline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a lap of 59 s at up to 0.8 g, as a trajectory optimiser writes it."""
    path = reference("circuit-1", load("bmw-320i"), SpeedChoice("grip", grip=0.85))
    slower = path.duration / LAP
    assert 0.9 < slower < 1.0
    nodes = slice(0, -1, 4)
    rows = np.column_stack(
        [
            path.arc_length[nodes], path.x[nodes], path.y[nodes], path.heading[nodes],
            path.curvature[nodes], slower * path.speed[nodes], slower**2 * path.acceleration[nodes],
        ]
    )  # fmt: skip
    file = tmp_path_factory.mktemp("raceline") / "raceline.csv"
    np.savetxt(file, rows, "%.7f", "; ", header=HEADER)
    return file


def test_its_reference_takes_as_long_as_the_file_says(raceline: Path) -> None:
    path = load_path(raceline, vehicle=load("bmw-320i"))
    assert path.closed
    assert path.duration == pytest.approx(LAP, rel=2e-3)


@pytest.mark.parametrize("agent", ["lpv-nmpc", "stanley"])
def test_agents_take_as_long_as_the_file_says(raceline: Path, agent: str) -> None:
    result = run_case({"agent": agent, "trajectory": str(raceline), "vehicle": "bmw-320i"})
    assert result["end"] == "finished"
    assert result["warnings"] == []
    assert result["metrics"]["lap_time"] == pytest.approx(LAP, rel=0.01)
    assert result["metrics"]["mle"] < 0.05
