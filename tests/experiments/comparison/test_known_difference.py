"""A comparison of few drives covers the difference that ten times as many drives show."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binom

from experiments.comparison.competitors import Competitor, pairs_between, read_folder
from experiments.comparison.measures import measure_of
from experiments.comparison.outcomes import Metric, compare
from experiments.run import resampling
from experiments.run.case import run_case
from experiments.run.store import ResultStore

SEEDS, TIMES = 4, 10
MEASURES = [measure_of(key) for key in ("ale", "rms_speed_error", "steering_rate_rms", "jerk_rms")]

Compare = Callable[[range], list[Metric]]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Compare:
    """Drive two short bends with Stanley's gain unchanged and changed; compare given seeds."""
    root = tmp_path_factory.mktemp("driven")
    bends = []
    for name, radius in (("wide", 25.0), ("narrow", 15.0)):
        angle = np.linspace(0.0, 13.0 / radius, 14)
        points = radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
        bends.append(root / f"{name}.csv")
        np.savetxt(bends[-1], points, delimiter=",", header="x,y", comments="")
    for name, settings in (("before", {}), ("after", {"gain": 0.75})):
        store = ResultStore(root / name)
        for seed in range(SEEDS * TIMES):
            for bend in bends:
                spec = {"agent": "stanley", "trajectory": str(bend), "agent_settings": settings}
                result = run_case({**spec, "conditions": "realtime", "seed": seed})
                store.append({**result, "trace": {}})
    folders = [read_folder(root / name, MEASURES, []) for name in ("before", "after")]
    drives = {key: one for folder in folders for key, one in folder.drives.items()}
    (pair,) = pairs_between(folders, [], None)

    def of(seeds: range) -> list[Metric]:
        few = (
            Competitor(
                one.folder,
                one.label,
                {key: runs for key, runs in one.runs.items() if drives[key].seed in seeds},
            )
            for one in pair
        )
        return compare(*few, drives, MEASURES, {}).metrics

    return of


def test_intervals_cover_the_difference_of_ten_times_as_many_drives(
    compared: Compare, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resampling, "RESAMPLES", 1000)
    truth = compared(range(SEEDS * TIMES))
    blocks = [compared(range(SEEDS * k, SEEDS * (k + 1))) for k in range(TIMES)]
    for place, true in enumerate(truth):
        found = [block[place].difference for block in blocks]
        held = sum(one.low <= true.difference.value <= one.high for one in found)
        # A percentile interval of a mean over four seeds covers it some 80 % of the time.
        assert held >= binom.ppf(1e-3, TIMES, 0.8), true.measure.key
        assert np.median([one.high - one.low for one in found]) > (
            true.difference.high - true.difference.low
        )
    ale = truth[0].difference
    assert ale.low > 0.0, "a lower gain tracks worse"
