"""A small share of every campaign."""

import importlib
import importlib.util

import pytest

from tests.campaigns.__main__ import CAMPAIGNS

SMALL = {
    "hostile_solves": 200, "hostile_files": 200, "hostile_commands": 10, "kill_jobs": 3,
    "kill_ray": 2,
    "soak": 20_000, "hostile_arguments": 15, "many_cases": 20,
}  # fmt: skip


@pytest.mark.parametrize("name", list(CAMPAIGNS))
def test_nothing_breaks(name: str) -> None:
    if name == "kill_ray" and importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed: pip install 'lpv-track-env[ray]'")
    module = importlib.import_module(f"tests.campaigns.{name}")
    counts = module.run(SMALL[name], 1, lambda _: None)
    assert counts.faults == []
    assert counts.tried >= SMALL[name]
