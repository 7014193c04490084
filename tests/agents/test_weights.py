"""Weights and schedules: validation, selection, blending, files."""

import copy
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.nmpc.schedule import NO_BAND, Switching
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule, weights_from
from lpv_track_env.observation import PREVIEW_START
from trajectories import CurvatureBands, load

EDGES = (0.005, 0.02, 0.05)
SETS = tuple(TrackingWeights(Q=(k, 1, 10, 10), S=(5, 5, 50, 50 * k)) for k in (1, 2, 3, 4))
weight = st.floats(LOWEST, HIGHEST)
weights = st.lists(weight, min_size=12, max_size=12).map(TrackingWeights.from_array)


def schedule(blend: float = 0.0, hysteresis: float = 0.2, **others: Any) -> WeightSchedule:
    return WeightSchedule(CurvatureBands(EDGES, hysteresis=hysteresis), SETS, blend, **others)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"Q": (1, 1, 1)}, "Q must be 4 numbers"),
        ({"S": (1, 1, 1, 1, 1)}, "S must be 4 numbers"),
        ({"R": ()}, "R must be 2 numbers"),
        ({"R_rate": (1, 1, 1)}, "R_rate must be 2 numbers"),
        ({"R_rate": (-1, 1)}, r"R_rate\[0\] must be >= 0 and finite, not -1"),
        ({"Q": (1, -1e-9, 1, 1)}, r"Q\[1\] must be >= 0 and finite, not -1e-09"),
        ({"S": (1, 1, math.nan, 1)}, r"S\[2\] must be >= 0 and finite, not nan"),
        ({"R": (math.inf, 1)}, r"R\[0\] must be >= 0 and finite, not inf"),
    ],
)
def test_wrong_weights_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackingWeights(**wrong)


@pytest.mark.parametrize("values", [[1.0] * 10, [1.0] * 13, np.ones((2, 6)), np.ones((12, 1)), 1.0])
def test_a_vector_of_another_shape_is_refused(values: Any) -> None:
    with pytest.raises(ValueError, match="12 weights are needed"):
        TrackingWeights.from_array(values)


@given(weights)
def test_array_round_trip(given_weights: TrackingWeights) -> None:
    array = given_weights.as_array()
    assert array.shape == (12,)
    assert TrackingWeights.from_array(array) == given_weights
    one = given_weights
    np.testing.assert_array_equal(array, [*one.Q, *one.S, *one.R, *one.R_rate])


def test_clipped_brings_every_weight_within_bounds() -> None:
    wild = TrackingWeights(Q=(0, 1e12, 1, 1e-9), R=(1e7, 0), R_rate=(0, 1e9))
    clipped = wild.clipped()
    assert clipped.Q == (LOWEST, HIGHEST, 1.0, LOWEST)
    assert clipped.R == (HIGHEST, LOWEST)
    assert clipped.R_rate == (LOWEST, HIGHEST)
    assert clipped.S == wild.S
    assert clipped.clipped() == clipped


def select(
    schedule: WeightSchedule, curvature: list[float], band: int = NO_BAND
) -> tuple[TrackingWeights, int]:
    """Weights and band that an NMPC uses for a preview of curvature, after another band."""
    steps = len(curvature)
    rows = np.zeros((1, PREVIEW_START + 2 * steps))
    rows[0, PREVIEW_START : PREVIEW_START + steps] = curvature
    bands, used = np.array([band]), np.zeros((1, 12))
    Switching(schedule, 0.05).choose(rows, steps, bands, used)
    return TrackingWeights.from_array(used[0]), int(bands[0])


@given(weights, weights, st.floats(0.01, 0.99))
@settings(deadline=None)  # compiles
def test_blended_is_the_geometric_mean(
    one: TrackingWeights, other: TrackingWeights, share: float
) -> None:
    blended = WeightSchedule(CurvatureBands((1.0,), ("low", "high")), (one, other), blend=0.5)
    mean = select(blended, [0.5 + share])[0].as_array()
    expected = one.as_array() ** (1 - share) * other.as_array() ** share
    np.testing.assert_allclose(mean, expected, rtol=1e-9)


def test_half_way_between_1_and_100_is_10() -> None:
    sets = tuple(TrackingWeights.from_array([value] * 12) for value in (1.0, 100.0))
    blended = WeightSchedule(CurvatureBands((1.0,), ("low", "high")), sets, blend=0.5)
    np.testing.assert_allclose(select(blended, [1.0])[0].as_array(), 10.0)


@pytest.mark.parametrize(
    ("trajectory", "band"),
    # Sharpest radii: none, 26 m, 11 m, and a kink.
    [("straight", 0), ("T6", 2), ("T1", 3), ("T1-raw", 3)],
)
@pytest.mark.parametrize("blend", [0.0, 0.3])
def test_for_path_goes_by_the_sharpest_curvature(trajectory: str, band: int, blend: float) -> None:
    assert schedule(blend).for_path(load(trajectory)) is SETS[band]
    assert schedule(blend).for_path(load(trajectory).mirrored()) is SETS[band]


def test_the_number_of_sets_fits_the_bands() -> None:
    with pytest.raises(ValueError, match="4 bands need as many sets, not 3"):
        WeightSchedule(CurvatureBands(EDGES), SETS[:3])


def test_select_takes_the_sharpest_of_either_sign() -> None:
    assert select(schedule(), [0.0, 0.001]) == (SETS[0], 0)
    assert select(schedule(), [0.0, -0.03, 0.01]) == (SETS[2], 2)
    assert select(schedule(), [0.0, -0.03, 0.06], 0) == (SETS[3], 3)


@pytest.mark.parametrize("blend", [0.0, 0.2])
def test_select_on_no_preview_is_straight(blend: float) -> None:
    assert select(schedule(blend), []) == (SETS[0], 0)


def flicker(hysteresis: float) -> list[int]:
    bands, band = [], NO_BAND
    for k in range(40):
        _, band = select(schedule(hysteresis=hysteresis), [0.02 * (1 + 0.05 * (-1) ** k)], band)
        bands.append(band)
    return bands


def test_hysteresis_does_not_flicker() -> None:
    assert len(set(flicker(0.0))) == 2
    assert set(flicker(0.2)) == {2}


def test_hysteresis_lets_go_below_its_share() -> None:
    held, band = select(schedule(), [0.0161], 2)
    assert (held, band) == (SETS[2], 2)
    assert select(schedule(), [0.0159], 2) == (SETS[1], 1)
    assert select(schedule(), [0.0], 3) == (SETS[0], 0)
    # Upwards at once, also over two bands.
    assert select(schedule(), [0.0201], 0) == (SETS[2], 2)


near_an_edge = st.builds(
    lambda edge, side, off: edge * (1 + side) * (1 + off),
    st.sampled_from(EDGES),
    st.sampled_from([-0.4, -0.25, -0.1, 0.0, 0.1, 0.25, 0.4]),
    st.floats(-1e-6, 1e-6),
)


@given(
    sets=st.tuples(weights, weights, weights, weights),
    blend=st.sampled_from([0.1, 0.25, 0.4]),
    curvature=near_an_edge | st.floats(0.0, 0.3),
)
@settings(max_examples=200, deadline=None)
def test_blending_is_continuous(
    sets: tuple[TrackingWeights, ...], blend: float, curvature: float
) -> None:
    blended = WeightSchedule(CurvatureBands(EDGES), sets, blend)
    here, there = (
        np.log(select(blended, [value])[0].as_array())
        for value in (curvature, curvature * (1 + 1e-6))
    )
    # Slope over one zone: log(HIGHEST / LOWEST) on a width of 2 blend, relative to its edge.
    slope = math.log(HIGHEST / LOWEST) / (2 * blend) * (1 + blend)
    assert np.abs(there - here).max() <= 1.01e-6 * slope + 1e-9


def test_blending_ends_at_the_bands_own_sets_and_meets_half_way() -> None:
    blended = schedule(0.25)
    assert select(blended, [0.0149])[0] == SETS[1]
    assert select(blended, [0.0251])[0] == SETS[2]
    middle = select(blended, [-0.02])[0]
    ends = np.log([SETS[1].as_array(), SETS[2].as_array()])
    np.testing.assert_allclose(middle.as_array(), np.exp(ends.mean(axis=0)))


@pytest.mark.parametrize("blend", [0.43, 0.99, 1.0, -0.1, math.nan])
def test_overlapping_zones_are_refused(blend: float) -> None:
    # Around 0.02 and 0.05 they touch at 3/7.
    with pytest.raises(ValueError, match=r"blend .*must (not overlap|be a finite number)"):
        schedule(blend)
    schedule(0.42)


def test_file_round_trip(tmp_path: Path) -> None:
    file = tmp_path / "new" / "schedule.json"
    written = schedule(
        0.3, slew=4.0, provenance={"tuner": "random search", "seed": 3, "é": [1.5, None]}
    )
    written.write(file)
    assert WeightSchedule.read(file) == written
    schedule().write(file)
    assert WeightSchedule.read(file) == schedule()
    assert [found.name for found in file.parent.iterdir()] == ["schedule.json"]


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    file = tmp_path / "schedule.json"
    schedule().write(file)
    with pytest.raises(TypeError):
        schedule(0.3, provenance={"not": {"plain"}}).write(file)
    folder = tmp_path / "in_the_way"
    folder.mkdir()
    with pytest.raises(OSError, match="in_the_way"):
        schedule().write(folder)
    assert WeightSchedule.read(file) == schedule()
    assert sorted(found.name for found in tmp_path.iterdir()) == ["in_the_way", "schedule.json"]


def content() -> dict[str, Any]:
    written: dict[str, Any] = {
        "format": "weight-schedule/3",
        "bands": {
            "thresholds": list(EDGES),
            "names": ["straight", "gentle", "moderate", "sharp"],
            "hysteresis": 0.2,
        },
        "weights": [
            {"Q": [*one.Q], "S": [*one.S], "R": [*one.R], "R_rate": [*one.R_rate]} for one in SETS
        ],
        "blend": 0.0,
        "slew": None,
        "provenance": {},
    }
    return written


def checked(file: Path, error: ValueError) -> str:
    message = str(error)
    assert message.startswith(f"weight schedule {file}: ")
    assert "\n" not in message
    return message


def refusal(file: Path) -> str:
    with pytest.raises(ValueError, match="weight schedule") as raised:
        WeightSchedule.read(file)
    return checked(file, raised.value)


def test_the_content_below_is_one_that_is_read(tmp_path: Path) -> None:
    file = tmp_path / "schedule.json"
    file.write_text(json.dumps(content()))
    assert WeightSchedule.read(file) == schedule()


@pytest.mark.parametrize("form", ["weight-schedule/1", "weight-schedule/2"])
def test_files_of_earlier_formats_have_no_weight_on_rates(tmp_path: Path, form: str) -> None:
    """The first format had no slew limit, either."""
    older = content()
    older["format"], older["slew"] = form, 4.0
    if form == "weight-schedule/1":
        del older["slew"]
    for one in older["weights"]:
        del one["R_rate"]
    file = tmp_path / "schedule.json"
    file.write_text(json.dumps(older))
    sets = tuple(dataclasses.replace(one, R_rate=(0.0, 0.0)) for one in SETS)
    slew = None if form == "weight-schedule/1" else 4.0
    found = WeightSchedule.read(file)
    assert found == dataclasses.replace(schedule(slew=slew), weights=sets)
    assert found == weights_from(older)
    # Once written anew, the file says so itself.
    found.write(file)
    assert WeightSchedule.read(file) == found
    assert json.loads(file.read_text())["weights"][0]["R_rate"] == [0.0, 0.0]


def test_a_set_without_weights_on_rates_has_the_default_ones(tmp_path: Path) -> None:
    """In a file of the present format; one of an earlier format has none."""
    shorter = content()
    del shorter["weights"][0]["R_rate"]
    file = tmp_path / "schedule.json"
    file.write_text(json.dumps(shorter))
    assert WeightSchedule.read(file) == schedule()


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        (("format",), "weight-schedule/4", "format is 'weight-schedule/4'"),
        (("slew",), 0.0, "slew must be positive 1/s, not 0.0"),
        (("slew",), "fast", "could not convert"),
        (("weights", 0, "Q", 2), -1.0, "Q[2] must be >= 0 and finite"),
        (("weights", 1, "S"), [1.0], "S must be 4 numbers"),
        (("weights", 1, "R", 0), "heavy", "R[0] must be >= 0 and finite"),
        (("weights", 2, "R_rate"), [1.0, -1.0], "R_rate[1] must be >= 0 and finite"),
        (("weights", 1, "R", 0), 10**400, "beyond 64 bits"),
        (("weights", 3, "Q", 0), math.inf, "Q[0] must be >= 0 and finite"),
        (("weights", 3), {"P": [1]}, "unexpected keyword argument 'P'"),
        (("weights",), [], "4 bands need as many sets, not 0"),
        (("bands", "thresholds"), [0.02, 0.01, 0.05], "thresholds must increase"),
        (("bands", "hysteresis"), 2.0, "hysteresis must be >= 0"),
        (("bands",), None, "NoneType"),
        (("blend",), 0.9, "zones must not overlap"),
        (("provenance",), 3, "int"),
    ],
)
def test_wrong_contents_are_one_line(
    tmp_path: Path, place: tuple[Any, ...], value: Any, reason: str
) -> None:
    wrong = content()
    inner: Any = wrong
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    file = tmp_path / "schedule.json"
    file.write_text(json.dumps(wrong))
    assert reason in refusal(file)


@pytest.mark.parametrize("key", ["bands", "weights", "blend", "provenance", "format"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    wrong = content()
    del wrong[key]
    file = tmp_path / "schedule.json"
    file.write_text(json.dumps(wrong))
    assert key in refusal(file)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"{", b"[]", b"3", b"not json", b"\xff\xfe\x00", b"[" * 100_000, b"9" * 10_000,
        json.dumps(content()).encode()[:-20],
    ],
    ids=lambda data: repr(data[:12]),
)  # fmt: skip
def test_what_is_no_schedule_is_one_line(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "schedule.json"
    file.write_bytes(data)
    refusal(file)


def test_what_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    refusal(tmp_path / "missing.json")
    refusal(tmp_path)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=5), inner, max_size=5)
    ),
    max_leaves=8,
)
places = [
    ("format",), ("bands",), ("bands", "thresholds"), ("bands", "names"), ("bands", "hysteresis"),
    ("bands", "thresholds", 1), ("weights",), ("weights", 2), ("weights", 2, "Q"),
    ("weights", 2, "Q", 0), ("blend",), ("provenance",),
]  # fmt: skip


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("weights") / "schedule.json"


@given(place=st.sampled_from(places), value=anything, extra=st.none() | st.text(max_size=5))
@settings(max_examples=200, deadline=None)
def test_garbage_is_read_or_refused(
    scratch: Path, place: tuple[Any, ...], value: Any, extra: str | None
) -> None:
    wrong = copy.deepcopy(content())
    inner: Any = wrong
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    if extra is not None:
        wrong["weights"] = [{**SETS[0].__dict__, extra: value}] * 4
    scratch.write_text(json.dumps(wrong))
    try:
        found = WeightSchedule.read(scratch)
    except ValueError as error:
        checked(scratch, error)
        return
    chosen, _ = select(found, [0.03])
    assert np.isfinite(chosen.as_array()).all()
    found.write(scratch)
    WeightSchedule.read(scratch)


# Weights as users give them.


def test_weights_are_taken_as_they_are_from_a_file_or_typed(tmp_path: Path) -> None:
    own = schedule(0.3, slew=4.0)
    own.write(tmp_path / "own.json")
    assert weights_from(SETS[1]) is SETS[1]
    assert weights_from(own) is own
    assert weights_from(tmp_path / "own.json") == weights_from(str(tmp_path / "own.json")) == own
    assert weights_from(own.as_dict()) == weights_from(json.loads(json.dumps(own.as_dict()))) == own
    assert weights_from({}) == TrackingWeights()
    assert weights_from({"Q": [1, 1, 20, 20]}) == TrackingWeights(Q=(1, 1, 20, 20))
    typed = {"weights": [{"R": [k, 1]} for k in (1, 2, 3, 4)], "slew": 6.0}
    found = weights_from(typed)
    assert isinstance(found, WeightSchedule)
    assert found.bands == CurvatureBands()
    assert (found.blend, found.slew) == (0.0, 6.0)
    assert [one.R for one in found.weights] == [(k, 1.0) for k in (1.0, 2.0, 3.0, 4.0)]
    two = {"weights": [{}, {}], "bands": {"thresholds": [0.01], "names": ["low", "high"]}}
    assert len(weights_from(two).weights) == 2  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (7, "weights must be weights, a schedule or its file, not int"),
        ({"P": [1]}, "unknown matrix of weights 'P'; known: Q, S, R, R_rate"),
        ({"Q": [1, 2]}, "Q must be 4 numbers"),
        ({"Q": 3}, "Q must be 4 numbers, each >= 0 and finite, not 3"),
        ({"Q": ["a", 1, 1, 1]}, r"Q\[0\] must be >= 0 and finite, not 'a'"),
        ({"R": [0.1, -1]}, r"R\[1\] must be >= 0 and finite, not -1"),
        ({"weights": [{}]}, "4 bands need as many sets, not 1"),
        ({"weights": 3}, "not iterable"),
        ({"weights": [], "bands": 7}, "not a mapping"),
        ({"weights": [{}] * 4, "format": "mine/1"}, "format is 'mine/1'"),
        ("no_such.json", "weight schedule no_such.json"),
    ],
)
def test_what_is_no_weights_is_refused_in_one_line(value: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as raised:
        weights_from(value)
    assert "\n" not in str(raised.value)
