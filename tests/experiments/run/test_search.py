"""Bisection for the highest value that passes, within a case and by itself."""

import pytest

from experiments.run.case import Case, run_case
from experiments.run.search import Search, passes

ENTRY = {"setting": "fixed_speed", "low": 8.0, "high": 30.0, "resolution": 0.25}


def driven(value: float, highest: float, *, lap: bool = False) -> dict:
    metrics = {"lap_time": 100.0 / value} if lap else {}
    return {"end": "finished" if value <= highest else "left_corridor", "metrics": metrics}


@pytest.mark.parametrize("highest", [*range(8, 31, 2), 8.1, 17.3, 29.99, 29.74])
def test_bisection_finds_the_last_value_of_the_grid_that_passes(highest: float) -> None:
    wanted = Search(**ENTRY)
    values = []
    found = wanted.run(lambda value: values.append(value) or driven(value, highest))  # type: ignore[func-returns-value]
    expected = max(v for k in range(89) if (v := 8.0 + 0.25 * k) <= highest)
    assert found["metrics"] == {"highest_fixed_speed": expected}
    assert found["end"] == "finished"
    assert found["tried"] == [[value, value <= highest] for value in values]
    assert len(values) == len(set(values)) <= 2 + 7


def test_an_agent_that_never_passes_has_its_slowest_drive_and_no_value() -> None:
    found = Search(**ENTRY).run(lambda value: {**driven(value, 1.0), "speed": value})
    assert found == {
        "end": "left_corridor", "metrics": {}, "speed": 8.0, "tried": [[8.0, False]]
    }  # fmt: skip


def test_the_fastest_lap_is_that_of_all_drives_that_pass() -> None:
    laps = Search("grip", 0.4, 1.2, 0.01)
    found = laps.run(lambda value: driven(value, 0.777, lap=True))
    assert found["metrics"]["highest_grip"] == 0.77
    assert found["metrics"]["fastest_lap"] == pytest.approx(100.0 / 0.77)
    # Drives that end early have the least "lap times" of all, and do not count.
    assert min(value for value, passed in found["tried"] if not passed) == 0.78


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"setting": "mass"}, "unknown setting of a search 'mass'"),
        ({"high": 8.0}, "search: high must be above low, 8, by at most"),
        ({"resolution": 1e-9}, "search: high must be above low"),
        ({"resolution": 0.0}, "search: resolution must be"),
        ({"low": float("nan")}, "search: low must be"),
    ],
)
def test_searches_without_a_grid_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Search(**{**ENTRY, **changes})


def test_a_drive_passes_if_it_finishes_without_touching_cones() -> None:
    for end, clearance, expected in (
        ("finished", 0.0, True), ("finished", -1e-9, False), ("time_limit", 1.0, False),
    ):  # fmt: skip
        assert passes({"end": end, "metrics": {"cone_clearance": clearance}}) is expected
    assert passes({"end": "finished", "metrics": {}})


def test_a_case_searches_and_its_result_is_that_of_the_fastest_drive_that_passes() -> None:
    spec = {
        "agent": "stanley", "trajectory": "circle", "speed_mode": "fixed",
        "conditions": {"name": "ideal", "friction": 0.5},
    }  # fmt: skip
    search = {"setting": "fixed_speed", "low": 4.0, "high": 20.0, "resolution": 0.5}
    result = run_case({**spec, "search": search})
    assert result["status"] == "ok", result
    highest = result["metrics"]["highest_fixed_speed"]
    # On 30 m of radius friction 0.5 allows 12.1 m/s, less where steering begins at zero.
    assert 10.0 <= highest <= 12.5
    assert {value for value, passed in result["tried"] if passed} >= {highest}
    alone = run_case({**spec, "fixed_speed": highest})
    assert alone["end"] == result["end"] == "finished"
    for name, value in alone["metrics"].items():
        assert result["metrics"][name] == value
    beyond = run_case({**spec, "fixed_speed": highest + 0.5})
    assert beyond["end"] == "left_corridor"
    # The same bits again.
    again = run_case({**spec, "search": search})
    keys = ("id", "tried", "metrics", "end")
    assert [again[key] for key in keys] == [result[key] for key in keys]


def test_a_case_refuses_a_value_beside_a_search_and_a_search_that_cannot_drive() -> None:
    lap = {"setting": "fixed_speed", "low": 4.0, "high": 8.0, "resolution": 1.0}
    cases = {
        "not both": Case("stanley", "circle", speed_mode="fixed", fixed_speed=3.0, search=lap),
        "needs speed_mode='fixed'": Case("stanley", "circle", search=lap),
        "at most the vehicle's top speed, 30": Case(
            "stanley", "circle", speed_mode="fixed", search={**lap, "high": 31.0}
        ),
        "unknown setting": Case("stanley", "circle", search={**lap, "setting": "speed"}),
    }
    for words, case in cases.items():
        with pytest.raises(ValueError, match=words):
            case.check()
