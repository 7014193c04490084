"""Conditions as they are given: fields, ranges, presets, errors."""

import json
import math
import re
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from lpv_track_env import conditions
from lpv_track_env.conditions import DRAWN, IDEAL, REALTIME, Conditions
from lpv_track_env.conditions import layout as conditions_layout
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.estimation.estimator import EstimatorSettings


def test_presets() -> None:
    assert conditions.load("simulation") is None
    assert conditions.load("realtime") is REALTIME
    assert conditions.load(REALTIME) is REALTIME
    assert conditions.load({"name": "realtime"}) is REALTIME
    raw = conditions.load({"name": "realtime", "estimator": "raw", "gnss_noise": [0.1, 0.3]})
    assert raw is not None
    assert raw.estimator == "raw"
    assert raw.gnss_noise == (0.1, 0.3)
    assert raw.steering_lag == REALTIME.steering_lag
    own = conditions.load({"estimator_settings": {"speed_noise": 0.2}})
    assert own is not None
    assert own.filter_settings == replace(IDEAL.filter_settings, speed_noise=0.2)


def test_the_filter_knows_its_sensors() -> None:
    poor = REALTIME.replace(gnss_noise=0.4, gnss_wander=0.3, heading_noise=(0.01, 0.03))
    settings = poor.filter_settings
    assert settings.position_deviation == pytest.approx(0.5, rel=1e-3)
    assert settings.heading_deviation == pytest.approx(0.02, rel=2e-3)
    assert settings.initial_steering_offset == 0.01
    # Nothing is believed without bound.
    assert min(IDEAL.filter_settings.initial_variances) > 0.0
    given = EstimatorSettings(position_deviation=2.0)
    assert poor.replace(estimator_settings=given).filter_settings is given


def test_every_number_of_realtime_is_in_the_table() -> None:
    """The table of the class names every field, and beside it the preset's own numbers."""
    table = {
        line.split()[0]: re.split(r"\s{2,}", line.strip())[2]
        for line in str(Conditions.__doc__).splitlines()
        if line.strip() and line.split()[0] in {*DRAWN, "gnss_period"}
    }
    assert set(table) == {*DRAWN, "gnss_period"}
    for name in ("gnss_period", *DRAWN):
        if name == "gnss_dropout_rate":
            assert table[name].strip() == "1/60"
            continue
        told = [float(word) for word in table[name].split() if word != "to"]
        ends = {*REALTIME.ends(name)}
        assert sorted(told) == pytest.approx(sorted(ends)), name


def test_departures_from_ideal() -> None:
    assert dict(IDEAL.departures()) == {}
    changed = Conditions(steering_lag=0.1, estimator="raw")
    assert dict(changed.departures()) == {"steering_lag": 0.1, "estimator": "raw"}


def test_plain_values() -> None:
    stored = json.loads(json.dumps(REALTIME.as_dict()))
    assert stored["name"] == "realtime"
    assert stored["steering_lag"] == [0.06, 0.12]


def test_nominal_actuation_is_the_middle_of_the_ranges() -> None:
    known = REALTIME.actuation
    assert known.steering_lag == pytest.approx(0.09)
    assert known.computing_delay == pytest.approx(0.0125)
    assert PathTrackingEnv("T2").actuation == (0.0,) * 5


def test_draws_are_uniform_over_the_ranges_and_differ_between_episodes() -> None:
    env = PathTrackingEnv("T2", conditions="realtime")
    drawn = []
    for seed in range(400):
        env.reset(seed=seed)
        assert env._conditioned is not None
        drawn.append(env._conditioned.vehicle[: len(DRAWN)].copy())
    values = np.array(drawn)
    ranges = REALTIME.ranges()
    np.testing.assert_array_equal(values.min(axis=0) >= ranges[:, 0], True)
    np.testing.assert_array_equal(values.max(axis=0) <= ranges[:, 1], True)
    width = ranges[:, 1] - ranges[:, 0]
    spread = width > 0
    shares = (values[:, spread] - ranges[spread, 0]) / width[spread]
    # Of 400 uniform numbers: mean 0.5 +- 0.0144, and no two fields alike.
    assert np.abs(shares.mean(axis=0) - 0.5).max() < 4.5 * math.sqrt(1 / 12 / 400)
    correlation = np.corrcoef(shares.T) - np.eye(spread.sum())
    assert np.abs(correlation).max() < 4.5 / math.sqrt(400)
    env.reset(seed=5)
    first = env._conditioned.vehicle[: len(DRAWN)].copy()
    env.reset()
    assert (env._conditioned.vehicle[: len(DRAWN)] != first)[spread].all()
    env.reset(seed=5)
    np.testing.assert_array_equal(env._conditioned.vehicle[: len(DRAWN)], first)


def test_memory_indices_follow_the_fields() -> None:
    for index, name in enumerate(DRAWN):
        assert getattr(conditions_layout, name.upper()) == index


BAD: dict[str, tuple[Any, str]] = {
    "name": ("real-time", r"unknown conditions 'real-time'.*nearest: realtime"),
    "field": ({"gnss_nose": 1.0}, r"unknown field of conditions 'gnss_nose'.*nearest: gnss_noise"),
    "preset": ({"name": "real"}, r"unknown conditions 'real'"),
    "setting": (
        {"estimator_settings": {"gate": 1.0}}, r"unknown estimator setting 'gate'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_unknown_names(case: str) -> None:
    given, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        PathTrackingEnv("T2", conditions=given)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gnss_noise", -0.1),
        ("gnss_noise", math.nan),
        ("gnss_noise", (0.2, 0.1)),
        ("gnss_noise", (0.1, 0.2, 0.3)),
        ("gnss_noise", "much"),
        ("mass_factor", 0.0),
        ("friction", (0.5, math.inf)),
        ("slippery_stretch", (-1.0, 3.0)),
        ("slippery_stretch", 3.0),
        ("slippery_factor", 0.0),
        ("computing_delay", 5.0),
        ("steering_offset", math.inf),
        ("gnss_period", 0.0),
        ("max_fix_age", 0.0),
        ("estimator", "kalman"),
    ],
)
def test_bad_values(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        Conditions(**{name: value})


def test_all_drawn_fields_are_ranges() -> None:
    assert len(DRAWN) == conditions_layout.COUNT
    assert {item.name for item in fields(Conditions)} > set(DRAWN)
